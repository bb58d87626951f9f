// The sum of all words before each word, from the sums before each block.
struct Params { count: u32, blocks: u32 }
@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> values: array<u32>;
@group(0) @binding(2) var<storage, read> sums: array<u32>;
@group(0) @binding(3) var<storage, read_write> before: array<u32>;

const SCANNED: u32 = 256u;
var<workgroup> shared_sums: array<u32, SCANNED>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) at: u32) {
    let block = group_index(group, groups);
    let first = block * 2048u + at * 8u;
    var own: array<u32, 8>;
    var sum = 0u;
    for (var i = 0u; i < 8u; i++) {
        own[i] = 0u;
        if first + i < params.count {
            own[i] = values[first + i];
        }
        sum += own[i];
    }
    var total = inclusive_scan(sum, at) - sum;
    if block < params.blocks {
        total += sums[block];
    }
    for (var i = 0u; i < 8u; i++) {
        if first + i < params.count {
            before[first + i] = total;
        }
        total += own[i];
    }
}
