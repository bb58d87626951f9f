// Blends one tile of 16 x 16 pixels front to back. A thread has four pixels in a column, so that a splat read from shared memory serves
// all four. Entries are fetched in segments of 256; for the backward pass, the state of the pixels before each segment but the first
// is kept.
@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> ranges: array<vec2u>;
@group(0) @binding(2) var<storage, read> slots: array<u32>;
@group(0) @binding(3) var<storage, read> splat_of_slot: array<u32>;
@group(0) @binding(4) var<storage, read> footprints: array<vec4f>;
@group(0) @binding(5) var<storage, read> first_segments: array<u32>;
@group(0) @binding(6) var<storage, read_write> tile_of_segment: array<u32>;
// Segments of each tile that some pixel needed.
@group(0) @binding(7) var<storage, read_write> reached: array<u32>;
// [segment, channel, pixel]: red, green, blue, depth, transmittance.
@group(0) @binding(8) var<storage, read_write> states: array<f32>;
// Planes: red, green, blue, alpha, depth.
@group(0) @binding(9) var<storage, read_write> frame: array<f32>;

struct Held {
    // Centre relative to the tile's first pixel, a, b.
    place: vec4f,
    // c, log2 of the opacity, red, green.
    shape: vec4f,
    // Blue, depth.
    rest: vec2f,
}

var<workgroup> held: array<Held, 256>;
// Whether some pixel has not terminated; every thread that writes it writes 1.
var<workgroup> live: u32;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) at: u32) {
    let tile = group_index(group, groups);
    let tiles = view.size.z * view.size.w;
    // Tiles beyond the last have no entries.
    var range = vec2u(0u);
    var first_segment = 0u;
    if tile < tiles {
        range = ranges[tile];
        first_segment = first_segments[tile];
    }
    let corner = vec2u(tile % view.size.z, tile / view.size.z) * TILE;
    let column = at % TILE;
    let row = 4u * (at / TILE);
    let origin = vec2f(corner) + 0.5;
    let segments = (range.y - range.x + 255u) / 256u;
    let trains = has(view.flags.x, FLAG_TRAINS);

    // A pixel that has terminated holds its transmittance with the sign flipped.
    var t = vec4f(1.0);
    var red = vec4f(0.0);
    var green = vec4f(0.0);
    var blue = vec4f(0.0);
    var depth = vec4f(0.0);
    var segment = 0u;
    for (; segment < segments; segment++) {
        workgroupBarrier();
        if at == 0u {
            live = 0u;
        }
        workgroupBarrier();
        if any(t > vec4f(0.0)) {
            live = 1u;
        }
        let first = range.x + segment * 256u;
        let count = min(range.y - first, 256u);
        for (var k = at; k < count; k += 64u) {
            let i = splat_of_slot[slots[first + k]];
            let a = footprints[3u * i];
            let c = footprints[3u * i + 2u];
            held[k] = Held(vec4f(a.xy - origin, a.zw), footprints[3u * i + 1u], c.xy);
        }
        if workgroupUniformLoad(&live) == 0u {
            break;
        }
        if trains {
            let s = first_segment + segment;
            if at == 0u {
                tile_of_segment[s] = tile;
            }
            if segment > 0u {
                for (var r = 0u; r < 4u; r++) {
                    let to = s * 5u * TILE_PIXELS + (row + r) * TILE + column;
                    states[to] = red[r];
                    states[to + TILE_PIXELS] = green[r];
                    states[to + 2u * TILE_PIXELS] = blue[r];
                    states[to + 3u * TILE_PIXELS] = depth[r];
                    states[to + 4u * TILE_PIXELS] = t[r];
                }
            }
        }
        for (var k = 0u; k < count && any(t > vec4f(0.0)); k++) {
            let place = held[k].place;
            let shape = held[k].shape;
            let dx = f32(column) - place.x;
            let dy = vec4f(0.0, 1.0, 2.0, 3.0) + (f32(row) - place.y);
            let p = fma(fma(vec4f(shape.x), dy, vec4f(place.w * dx)), dy, vec4f(fma(place.z * dx, dx, shape.y)));
            let touched = (p >= vec4f(LOG2_ALPHA_MIN)) & (t > vec4f(0.0));
            if any(touched) {
                let weight = min(exp2(p), vec4f(ALPHA_MAX)) * t;
                let behind = t - weight;
                let is_visible = behind > vec4f(TRANSMITTANCE_MIN);
                let w = select(vec4f(0.0), weight, touched & is_visible);
                red += w * shape.z;
                green += w * shape.w;
                blue += w * held[k].rest.x;
                depth += w * held[k].rest.y;
                t = select(t, select(-t, behind, is_visible), touched);
            }
        }
    }
    if tile >= tiles {
        return;
    }
    if trains {
        if at == 0u {
            reached[tile] = segment;
        }
        // Segments that no pixel needed also get their tile: their gradients are zeros.
        for (var s = segment + at; s < segments; s += 64u) {
            tile_of_segment[first_segment + s] = tile;
        }
    }
    let pixels = view.size.x * view.size.y;
    for (var r = 0u; r < 4u; r++) {
        let pixel = corner + vec2u(column, row + r);
        if all(pixel < view.size.xy) {
            let to = pixel.y * view.size.x + pixel.x;
            let left = abs(t[r]);
            frame[to] = red[r] + left * view.background.x;
            frame[pixels + to] = green[r] + left * view.background.y;
            frame[2u * pixels + to] = blue[r] + left * view.background.z;
            frame[3u * pixels + to] = 1.0 - left;
            frame[4u * pixels + to] = depth[r];
        }
    }
}
