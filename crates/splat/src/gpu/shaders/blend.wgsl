// Blends one tile of 16 x 16 pixels front to back, a pixel a thread. Entries are fetched in segments of 256; for the backward pass,
// the state of the pixels before each segment but the first is kept.
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
    xy: vec2f,
    quadratic: vec3f,
    log2_opacity: f32,
    color: vec3f,
    depth: f32,
}

var<workgroup> held: array<Held, 256>;
// Whether some pixel has not ended; all that write it write 1.
var<workgroup> live: u32;

@compute @workgroup_size(256)
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
    let pixel = corner + vec2u(at % TILE, at / TILE);
    let center = vec2f(pixel) + 0.5;
    let segments = (range.y - range.x + 255u) / 256u;
    let trains = has(view.flags.x, FLAG_TRAINS);

    // A pixel that has ended holds its transmittance with the sign flipped.
    var t = 1.0;
    var color = vec3f(0.0);
    var depth = 0.0;
    var segment = 0u;
    for (; segment < segments; segment++) {
        workgroupBarrier();
        if at == 0u {
            live = 0u;
        }
        workgroupBarrier();
        if t > 0.0 {
            live = 1u;
        }
        let first = range.x + segment * 256u;
        let count = min(range.y - first, 256u);
        if at < count {
            let i = splat_of_slot[slots[first + at]];
            let a = footprints[3u * i];
            let b = footprints[3u * i + 1u];
            let c = footprints[3u * i + 2u];
            held[at] = Held(a.xy, vec3f(a.zw, b.x), b.y, vec3f(b.zw, c.x), c.y);
        }
        workgroupBarrier();
        if workgroupUniformLoad(&live) == 0u {
            break;
        }
        if trains {
            let s = first_segment + segment;
            if at == 0u {
                tile_of_segment[s] = tile;
            }
            if segment > 0u {
                let to = s * 5u * TILE_PIXELS + at;
                states[to] = color.x;
                states[to + TILE_PIXELS] = color.y;
                states[to + 2u * TILE_PIXELS] = color.z;
                states[to + 3u * TILE_PIXELS] = depth;
                states[to + 4u * TILE_PIXELS] = t;
            }
        }
        for (var k = 0u; k < count && t > 0.0; k++) {
            let p = exponent(held[k].quadratic, held[k].log2_opacity, center - held[k].xy);
            let f = fragment(p, t);
            if f.drawn {
                color += f.weight * held[k].color;
                depth += f.weight * held[k].depth;
                t = f.transmittance;
            } else if f.ends {
                t = -t;
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
        // What no pixel needed has a tile as well: its gradients are zeros.
        for (var s = segment + at; s < segments; s += 256u) {
            tile_of_segment[first_segment + s] = tile;
        }
    }
    if all(pixel < view.size.xy) {
        let pixels = view.size.x * view.size.y;
        let to = pixel.y * view.size.x + pixel.x;
        let left = abs(t);
        frame[to] = color.x + left * view.background.x;
        frame[pixels + to] = color.y + left * view.background.y;
        frame[2u * pixels + to] = color.z + left * view.background.z;
        frame[3u * pixels + to] = 1.0 - left;
        frame[4u * pixels + to] = depth;
    }
}
