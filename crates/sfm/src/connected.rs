//! Connected components.

/// The connected components of `count` items, such as photographs or pixels, largest first, each ascending.
pub(crate) fn connected<L: Iterator<Item = usize>>(count: usize, linked: impl Fn(usize) -> L) -> Vec<Vec<usize>> {
    let mut reached = vec![false; count];
    let mut parts: Vec<Vec<usize>> = Vec::new();
    for start in 0..count {
        if reached[start] {
            continue;
        }
        reached[start] = true;
        let mut part = vec![start];
        let mut next = 0;
        while next < part.len() {
            for other in linked(part[next]) {
                if !reached[other] {
                    reached[other] = true;
                    part.push(other);
                }
            }
            next += 1;
        }
        part.sort_unstable();
        parts.push(part);
    }
    parts.sort_by_key(|part| (std::cmp::Reverse(part.len()), part[0]));
    parts
}
