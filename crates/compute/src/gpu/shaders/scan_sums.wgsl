// Replaces the sum of each block by the sum of all blocks before it, in one workgroup; the total follows the last block.
struct Params { count: u32, blocks: u32 }
@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read_write> sums: array<u32>;

const SCANNED: u32 = 256u;
var<workgroup> shared_sums: array<u32, SCANNED>;

@compute @workgroup_size(256)
fn main(@builtin(local_invocation_index) at: u32) {
    var before = 0u;
    for (var first = 0u; first < params.blocks; first += 256u) {
        let i = first + at;
        var own = 0u;
        if i < params.blocks {
            own = sums[i];
        }
        let sum = inclusive_scan(own, at);
        if i < params.blocks {
            sums[i] = before + sum - own;
        }
        before += workgroupUniformLoad(&shared_sums[255]);
    }
    if at == 0u {
        sums[params.blocks] = before;
    }
}
