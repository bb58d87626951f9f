// How often each digit occurs in each block of 4,096 keys.
struct Params { count: u32, blocks: u32, shift: u32 }
@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> keys: array<u32>;
@group(0) @binding(2) var<storage, read_write> counts: array<u32>;

var<workgroup> digits: array<atomic<u32>, 16>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) at: u32) {
    let block = group_index(group, groups);
    if at < 16u {
        atomicStore(&digits[at], 0u);
    }
    workgroupBarrier();
    for (var i = 0u; i < 16u; i++) {
        let source = block * 4096u + i * 256u + at;
        if source < params.count {
            atomicAdd(&digits[(keys[source] >> params.shift) & 15u], 1u);
        }
    }
    workgroupBarrier();
    if at < 16u && block < params.blocks {
        counts[at * params.blocks + block] = atomicLoad(&digits[at]);
    }
}
