// Parameters of the passes of a sort whose number of keys is known on the device only. The workgroups that are dispatched suffice for the
// largest possible number; those beyond the actual number have nothing to do.
@group(0) @binding(0) var<storage, read> count: array<u32>;
// One part of 64 words per pass: count, blocks, shift.
@group(0) @binding(1) var<storage, read_write> params: array<u32>;

@compute @workgroup_size(32)
fn main(@builtin(local_invocation_index) at: u32) {
    if at < arrayLength(&params) / 64u {
        params[64u * at] = count[0];
        params[64u * at + 1u] = (count[0] + 2047u) / 2048u;
    }
}
