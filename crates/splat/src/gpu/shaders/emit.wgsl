// Lists the tiles of each visible splat, front to back. A slot is a place in this list; a stable sort by tile keeps the order of depth.
@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> order: array<u32>;
@group(0) @binding(2) var<storage, read> firsts: array<u32>;
@group(0) @binding(3) var<storage, read> touched: array<u32>;
@group(0) @binding(4) var<storage, read> footprints: array<vec4f>;
@group(0) @binding(5) var<storage, read_write> tiles: array<u32>;
@group(0) @binding(6) var<storage, read_write> slots: array<u32>;
@group(0) @binding(7) var<storage, read_write> splat_of_slot: array<u32>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) at: u32) {
    let j = group_index(group, groups) * 256u + at;
    if j >= view.found.x {
        return;
    }
    let i = order[j];
    var slot = firsts[j];
    let end = slot + touched[i];
    let s = outline_of(i);
    let columns = tile_columns(s);
    for (var column = columns.x; column <= columns.y; column++) {
        let rows = tile_rows(s, column);
        for (var row = rows.x; row <= rows.y && slot < end; row++) {
            tiles[slot] = u32(row) * view.size.z + u32(column);
            slots[slot] = slot;
            splat_of_slot[slot] = i;
            slot++;
        }
    }
    // Compilers may round the same formula differently here and where tiles were counted: slots that are left belong to no tile.
    for (; slot < end; slot++) {
        tiles[slot] = view.size.z * view.size.w;
        slots[slot] = slot;
        splat_of_slot[slot] = i;
    }
}
