// Parameters of the passes of a sort, and of its prefix sums, where the number of keys is known on the device alone. What is dispatched
// suffices for the largest number; workgroups beyond this one have nothing to do.
@group(0) @binding(0) var<storage, read> count: array<u32>;
// In parts of 64 words: count, blocks, shift of each pass; then the counts of digits, as one block and in blocks of 2,048.
@group(0) @binding(1) var<storage, read_write> params: array<u32>;

@compute @workgroup_size(32)
fn main(@builtin(local_invocation_index) at: u32) {
    let parts = arrayLength(&params) / 64u;
    let blocks = (count[0] + 4095u) / 4096u;
    if at + 2u < parts {
        params[64u * at] = count[0];
        params[64u * at + 1u] = blocks;
    } else if at < parts {
        let counts = 16u * blocks;
        params[64u * at] = counts;
        params[64u * at + 1u] = select((counts + 2047u) / 2048u, counts, at + 2u == parts);
    }
}
