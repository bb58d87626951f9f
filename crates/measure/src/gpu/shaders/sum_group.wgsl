// Sum over the threads of a workgroup, in a fixed order; valid in the first thread only. The kernel declares `shared_values`.
fn sum_group(own: vec3f, at: u32) -> vec3f {
    workgroupBarrier();
    shared_values[at] = own;
    for (var half = THREADS / 2u; half > 0u; half /= 2u) {
        workgroupBarrier();
        if at < half {
            shared_values[at] += shared_values[at + half];
        }
    }
    return shared_values[0];
}
