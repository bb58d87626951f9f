// Sums of blocks of 2,048 words.
struct Params { count: u32, blocks: u32 }
@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> values: array<u32>;
@group(0) @binding(2) var<storage, read_write> sums: array<u32>;

var<workgroup> shared_sums: array<u32, 256>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) at: u32) {
    let block = group_index(group, groups);
    var sum = 0u;
    for (var i = 0u; i < 8u; i++) {
        let source = block * 2048u + i * 256u + at;
        if source < params.count {
            sum += values[source];
        }
    }
    shared_sums[at] = sum;
    for (var half = 128u; half > 0u; half /= 2u) {
        workgroupBarrier();
        if at < half {
            shared_sums[at] += shared_sums[at + half];
        }
    }
    if at == 0u && block < params.blocks {
        sums[block] = shared_sums[0];
    }
}
