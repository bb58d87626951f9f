// How often each digit of eight bits occurs in each block of 2,048 keys.
struct Params { count: u32, blocks: u32, shift: u32 }
@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> keys: array<u32>;
// [block, digit].
@group(0) @binding(2) var<storage, read_write> counts: array<u32>;

var<workgroup> digits: array<atomic<u32>, 256>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) at: u32) {
    let block = group_index(group, groups);
    atomicStore(&digits[at], 0u);
    workgroupBarrier();
    for (var i = 0u; i < 8u; i++) {
        let source = block * 2048u + i * 256u + at;
        if source < params.count {
            atomicAdd(&digits[(keys[source] >> params.shift) & 255u], 1u);
        }
    }
    workgroupBarrier();
    if block < params.blocks {
        counts[block * 256u + at] = atomicLoad(&digits[at]);
    }
}
