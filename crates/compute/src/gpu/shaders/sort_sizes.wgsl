// Parameters of the passes of a sort, where the number of keys is known on the device alone. What is dispatched suffices for the largest
// number; workgroups beyond this one have nothing to do.
@group(0) @binding(0) var<storage, read> count: array<u32>;
// In parts of 64 words: count, blocks, shift of each pass.
@group(0) @binding(1) var<storage, read_write> params: array<u32>;

@compute @workgroup_size(32)
fn main(@builtin(local_invocation_index) at: u32) {
    if at < arrayLength(&params) / 64u {
        params[64u * at] = count[0];
        params[64u * at + 1u] = (count[0] + 2047u) / 2048u;
    }
}
