// The VJP of `encode` in the table, one thread per sample and level.
//
// Sums are 64-bit integers in units of 2^-50, two words each: the order in which threads add to them does not matter, so that the result
// is the same from run to run. (Sorting all contributions, the other way to a fixed order, would move 4 million pairs per step.)
@group(0) @binding(0) var<uniform> task: Task;
@group(0) @binding(1) var<storage, read> points: array<f32>;
@group(0) @binding(2) var<storage, read> v_rows: array<f32>;
@group(0) @binding(3) var<storage, read_write> sums: array<atomic<u32>>;

// Gradients are of a mean over rays, far below this.
const LARGEST: f32 = 4096.0;

fn add(at: u32, value: f32) {
    let scaled = min(abs(value), LARGEST) * 262144.0;
    let whole = floor(scaled);
    var low = u32((scaled - whole) * 4294967296.0);
    var high = u32(whole);
    if value < 0.0 {
        low = ~low + 1u;
        high = ~high + select(0u, 1u, low == 0u);
    }
    if low != 0u {
        let before = atomicAdd(&sums[2u * at], low);
        high += select(0u, 1u, before + low < low);
    }
    if high != 0u {
        atomicAdd(&sums[2u * at + 1u], high);
    }
}

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) at: u32) {
    let own = place(group_index(group, groups), at);
    if own.sample >= task.sizes.y {
        return;
    }
    var c = corners_at(own);
    for (var f = 0u; f < FEATURES; f++) {
        let v = v_rows[feature_at(own, f)];
        if v == 0.0 {
            continue;
        }
        for (var k = 0u; k < 8u; k++) {
            add(c.entry[k] * FEATURES + f, v * c.weight[k]);
        }
    }
}
