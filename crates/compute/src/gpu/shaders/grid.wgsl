// Workgroups are dispatched in rows, since a line has at most 65,535.
fn group_index(group: vec3u, groups: vec3u) -> u32 {
    return group.y * groups.x + group.x;
}
