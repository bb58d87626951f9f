// Moves, copies and zeroes rows of planes as density control has done with the row numbers.
struct Rows {
    // Rows, stride of their planes, stride of the planes before, planes.
    shape: vec4u,
    // First plane; first of the row numbers; unused.
    first: vec4u,
}
@group(0) @binding(0) var<uniform> rows: Rows;
// Source of each row: its previous number plus 1, or 0 for zeros.
@group(0) @binding(1) var<storage, read> numbers: array<u32>;
// Words rather than floats, which a device may round.
@group(0) @binding(2) var<storage, read> before: array<u32>;
@group(0) @binding(3) var<storage, read_write> after: array<u32>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) thread: u32) {
    let i = group_index(group, groups) * 256u + thread;
    if i >= rows.shape.y {
        return;
    }
    var number = 0u;
    if i < rows.shape.x {
        number = numbers[rows.first.y + i];
    }
    for (var plane = rows.first.x; plane < rows.first.x + rows.shape.w; plane++) {
        var word = 0u;
        if number > 0u {
            word = before[plane * rows.shape.z + number - 1u];
        }
        after[plane * rows.shape.y + i] = word;
    }
}
