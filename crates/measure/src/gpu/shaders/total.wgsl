// The sums over all groups, and the depth loss with its gradient, in one workgroup.
@group(0) @binding(0) var<uniform> task: Target;
@group(0) @binding(1) var<storage, read> frame: array<f32>;
@group(0) @binding(2) var<storage, read> sums: array<f32>;
// Sorted by pixel: pixel, depth and weight (bits of floats).
@group(0) @binding(3) var<storage, read> samples: array<u32>;
@group(0) @binding(4) var<storage, read_write> v_frame: array<f32>;
// Sums of absolute differences, squared differences, 1 - SSIM, weighted depth differences and weighted depths.
@group(0) @binding(5) var<storage, read_write> totals: array<f32>;

// Pixels less opaque than this do not count.
const MIN_ALPHA: f32 = 0.5;

const THREADS: u32 = 256u;
var<workgroup> shared_values: array<vec3f, 256>;

struct Sample {
    pixel: u32,
    difference: f32,
    depth: f32,
    rendered: f32,
    opacity: f32,
    // 0 if the sample does not count.
    weight: f32,
}

fn sample_at(i: u32) -> Sample {
    let pixels = task.size.x * task.size.y;
    let pixel = samples[3u * i];
    let depth = bitcast<f32>(samples[3u * i + 1u]);
    let opacity = frame[3u * pixels + pixel];
    let rendered = frame[4u * pixels + pixel] / opacity;
    var weight = bitcast<f32>(samples[3u * i + 2u]);
    if !(opacity >= MIN_ALPHA) || !(abs(rendered) < 1e30) {
        weight = 0.0;
    }
    return Sample(pixel, depth - rendered, depth, rendered, opacity, weight);
}

@compute @workgroup_size(256)
fn main(@builtin(local_invocation_index) at: u32) {
    var own = vec3f(0.0);
    for (var i = at; i < 3u * task.size.w; i += 256u) {
        own += vec3f(sums[3u * i], sums[3u * i + 1u], sums[3u * i + 2u]);
    }
    let photometric = sum_group(own, at);
    let count = task.flags.y;
    own = vec3f(0.0);
    for (var i = at; i < count; i += 256u) {
        let s = sample_at(i);
        if s.weight > 0.0 {
            own += s.weight * vec3f(abs(s.difference), s.depth, 0.0);
        }
    }
    let depth = sum_group(own, at);
    // Broadcast to all threads.
    workgroupBarrier();
    if at == 0u {
        totals[0] = photometric.x;
        totals[1] = photometric.y;
        totals[2] = photometric.z;
        totals[3] = depth.x;
        totals[4] = depth.y;
        shared_values[0] = depth;
    }
    let norm = workgroupUniformLoad(&shared_values[0]).y;
    if !(norm > 0.0) {
        return;
    }
    let pixels = task.size.x * task.size.y;
    for (var i = at; i < count; i += 256u) {
        let pixel = samples[3u * i];
        // The thread of a pixel's first sample adds all of that pixel's samples, in order.
        if i > 0u && samples[3u * max(i, 1u) - 3u] == pixel {
            continue;
        }
        var v_depth = 0.0;
        var v_alpha = 0.0;
        for (var k = i; k < count; k++) {
            let s = sample_at(k);
            if s.pixel != pixel {
                break;
            }
            if s.weight > 0.0 {
                let v = -task.gains.w * s.weight * sign(s.difference) / norm;
                v_depth += v / s.opacity;
                v_alpha -= v * s.rendered / s.opacity;
            }
        }
        v_frame[4u * pixels + pixel] += v_depth;
        v_frame[3u * pixels + pixel] += v_alpha;
    }
}
