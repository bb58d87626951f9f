// A tile of 16 x 16 pixels in one channel, for a workgroup of 128 threads with two vertically adjacent pixels each.
const THREADS: u32 = 128u;
// Iterations in which all threads together visit every pixel that the windows of a tile cover.
const SEEN_TURNS: u32 = 6u;

struct Tile {
    // Index among all tiles of all channels.
    number: u32,
    // 3 or more for groups beyond the last tile.
    channel: u32,
    // First pixel that the windows of the tile cover; may be outside the image.
    corner: vec2i,
}

fn tile_of(group: vec3u, groups: vec3u) -> Tile {
    let number = group_index(group, groups);
    let tile = number % task.size.w;
    let corner = vec2i(vec2u(tile % task.size.z, tile / task.size.z) * TILE) - i32(RADIUS);
    return Tile(number, number / task.size.w, corner);
}

// The index in a plane of pixel i of the SEEN x SEEN that a tile's windows cover; -1 outside the image.
fn seen_pixel(tile: Tile, i: u32) -> i32 {
    return pixel_at(tile, tile.corner + vec2i(vec2u(i % SEEN, i / SEEN)));
}

// The index in a plane of a pixel of the tile itself; -1 outside the image.
fn own_pixel(tile: Tile, column: u32, row: u32) -> i32 {
    return pixel_at(tile, tile.corner + i32(RADIUS) + vec2i(vec2u(column, row)));
}

fn pixel_at(tile: Tile, place: vec2i) -> i32 {
    let size = vec2i(task.size.xy);
    if tile.channel < 3u && all(place >= vec2i(0)) && all(place < size) {
        return place.y * size.x + place.x;
    }
    return -1;
}
