// Sum of the values of a workgroup's threads up to and including this one. The kernel defines `shared_sums` and `SCANNED`, the number of
// threads.
fn inclusive_scan(own: u32, at: u32) -> u32 {
    // Other threads may still read the previous contents.
    workgroupBarrier();
    shared_sums[at] = own;
    for (var reach = 1u; reach < SCANNED; reach *= 2u) {
        workgroupBarrier();
        var left = 0u;
        if at >= reach {
            left = shared_sums[at - reach];
        }
        workgroupBarrier();
        shared_sums[at] += left;
    }
    workgroupBarrier();
    return shared_sums[at];
}
