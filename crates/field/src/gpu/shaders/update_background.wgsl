// A step of Adam on a learnt background, one workgroup per coefficient. Twin: `background_vjp`.
@group(0) @binding(0) var<uniform> update: Update;
@group(0) @binding(1) var<storage, read> rays: array<Ray>;
@group(0) @binding(2) var<storage, read> losses: array<f32>;
@group(0) @binding(3) var<storage, read_write> parameters: array<f32>;
// Both moments, [2, parameters].
@group(0) @binding(4) var<storage, read_write> moments: array<f32>;

var<workgroup> sums: array<f32, 64>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) at: u32) {
    let i = group.x;
    let rays_in_all = update.sizes.y;
    var own = 0.0;
    for (var r = at; r < rays_in_all; r += 64u) {
        var toward = basis(3u, rays[r].view);
        own += toward[i / 3u] * losses[(2u + i % 3u) * rays_in_all + r];
    }
    sums[at] = own;
    for (var half = 32u; half > 0u; half /= 2u) {
        workgroupBarrier();
        if at < half {
            sums[at] += sums[at + half];
        }
    }
    if at == 0u && i < update.sizes.x {
        take_step(i, sums[0]);
    }
}
