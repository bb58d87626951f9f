// Sums of the losses of all rays, by one workgroup.
@group(0) @binding(0) var<uniform> task: Task;
@group(0) @binding(1) var<storage, read> losses: array<f32>;
@group(0) @binding(2) var<storage, read_write> totals: array<f32>;

var<workgroup> sums: array<vec2f, 256>;

@compute @workgroup_size(256)
fn main(@builtin(local_invocation_index) at: u32) {
    var own = vec2f(0.0);
    for (var r = at; r < task.sizes.x; r += 256u) {
        own += vec2f(losses[r], losses[task.sizes.x + r]);
    }
    sums[at] = own;
    for (var half = 128u; half > 0u; half /= 2u) {
        workgroupBarrier();
        if at < half {
            sums[at] += sums[at + half];
        }
    }
    if at == 0u {
        totals[0] = sums[0].x;
        totals[1] = sums[0].y;
    }
}
