//! Connected components.

/// The connected components of `count` items, such as photographs or pixels, largest first, each ascending.
pub(crate) fn connected_components<L: Iterator<Item = usize>>(
    count: usize,
    neighbours: impl Fn(usize) -> L,
) -> Vec<Vec<usize>> {
    let mut reached = vec![false; count];
    let mut components: Vec<Vec<usize>> = Vec::new();
    for start in 0..count {
        if reached[start] {
            continue;
        }
        reached[start] = true;
        let mut component = vec![start];
        let mut next = 0;
        while next < component.len() {
            for other in neighbours(component[next]) {
                if !reached[other] {
                    reached[other] = true;
                    component.push(other);
                }
            }
            next += 1;
        }
        component.sort_unstable();
        components.push(component);
    }
    components.sort_by_key(|component| (std::cmp::Reverse(component.len()), component[0]));
    components
}
