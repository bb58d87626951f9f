// The number of a workgroup. Workgroups are dispatched in rows, since there are at most 65,535 along one axis.
fn group_index(group: vec3u, groups: vec3u) -> u32 {
    return group.y * groups.x + group.x;
}
