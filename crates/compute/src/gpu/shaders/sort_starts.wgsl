// Replaces the count of a digit in each block by its count in all blocks before; the total goes to the row after the last block. A
// workgroup handles 8 digits with 32 threads each; a thread handles a run of blocks.
struct Params { count: u32, blocks: u32, shift: u32 }
@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read_write> counts: array<u32>;

var<workgroup> sums: array<u32, 256>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) at: u32) {
    let digit = 8u * group.x + at % 8u;
    let run = (params.blocks + 31u) / 32u;
    let first = min(at / 8u * run, params.blocks);
    let last = min(first + run, params.blocks);
    var sum = 0u;
    for (var block = first; block < last; block++) {
        sum += counts[block * 256u + digit];
    }
    sums[at] = sum;
    workgroupBarrier();
    var before = 0u;
    for (var i = at % 8u; i < at; i += 8u) {
        before += sums[i];
    }
    for (var block = first; block < last; block++) {
        let own = counts[block * 256u + digit];
        counts[block * 256u + digit] = before;
        before += own;
    }
    if at / 8u == 31u {
        counts[params.blocks * 256u + digit] = before;
    }
}
