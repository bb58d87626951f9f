//! The graph of overlap: parts, bridges, cut points and photographs with few partners.

use super::{Diagnosis, Evidence, Graph};

/// Minimum number of partners for a photograph to be well connected.
const PARTNERS: usize = 3;
/// Minimum number of photographs of a capture whose photographs can be expected to overlap more than once.
const CAPTURE: usize = 6;
/// Minimum number of photographs of a part: fewer are reported as photographs with few partners.
const PART: usize = 3;

/// All diagnoses about the graph of overlap.
pub(super) fn overlap(evidence: &Evidence, graph: &Graph) -> Vec<Diagnosis> {
    let mut found = Vec::new();
    let n = evidence.photos.len();
    if n < 2 {
        return found;
    }
    let parts: Vec<Vec<usize>> = graph.parts().into_iter().filter(|part| part.len() >= PART).collect();
    if parts.len() > 1 {
        found.push(Diagnosis::SeparateParts { parts });
    }
    if n < CAPTURE {
        return found;
    }
    // The faces of panoramas link the panoramas, so single pairs of faces would look like bridges.
    if !(0..n).any(|photo| graph.is_on_rig(photo)) {
        found.extend(weak_links(graph));
    }
    for photo in 0..n {
        let partners: Vec<usize> = graph.partners[photo].iter().map(|p| p.0).collect();
        if partners.len() < PARTNERS && !graph.is_on_rig(photo) {
            found.push(Diagnosis::FewPartners { photo, partners });
        }
    }
    found
}

/// Bridges and cut points (Tarjan 1972), where each side has at least [`PART`] photographs.
fn weak_links(graph: &Graph) -> Vec<Diagnosis> {
    let n = graph.partners.len();
    let mut found = Vec::new();
    for part in graph.parts() {
        let size = part.len();
        let mut search = Search {
            graph,
            order: vec![usize::MAX; n],
            low: vec![usize::MAX; n],
            below: vec![1; n],
            members: Vec::new(),
        };
        search.visit(part[0], &mut |search, parent, child| {
            let (behind, rest) = (search.below[child], size - search.below[child]);
            if search.low[child] > search.order[parent] && behind >= PART && rest >= PART {
                found.push(Diagnosis::Bridge {
                    photos: [parent.min(child), parent.max(child)],
                    sides: [rest, behind],
                });
            } else if search.low[child] >= search.order[parent] && behind >= PART && rest > PART {
                // The parent belongs to neither side.
                let mut behind_it: Vec<usize> = search.members[search.order[child]..].to_vec();
                if 2 * behind > size {
                    behind_it = part
                        .iter()
                        .copied()
                        .filter(|p| *p != parent && !behind_it.contains(p))
                        .collect();
                }
                behind_it.sort_unstable();
                found.push(Diagnosis::CutPoint {
                    photo: parent,
                    behind: behind_it,
                });
            }
        });
    }
    // The ends of a bridge are cut points too, and the root of the search is one for each of its branches.
    let mut named: Vec<usize> = found
        .iter()
        .filter(|d| matches!(d, Diagnosis::Bridge { .. }))
        .flat_map(Diagnosis::photos)
        .collect();
    found.retain(|diagnosis| match diagnosis {
        Diagnosis::CutPoint { photo, .. } if named.contains(photo) => false,
        Diagnosis::CutPoint { photo, .. } => {
            named.push(*photo);
            true
        }
        _ => true,
    });
    found
}

/// Depth-first search.
struct Search<'a> {
    graph: &'a Graph,
    /// `[photos]` position of each in the order in which they were reached.
    order: Vec<usize>,
    /// `[photos]` the earliest photograph that each and those below it lead to.
    low: Vec<usize>,
    /// `[photos]` number of photographs below each, including itself.
    below: Vec<usize>,
    /// Photographs in the order in which they were reached.
    members: Vec<usize>,
}

impl Search<'_> {
    /// Calls `done(search, parent, child)` when everything below `child` has been visited.
    fn visit(&mut self, root: usize, done: &mut dyn FnMut(&Self, usize, usize)) {
        // The photograph, its parent, and its next partner.
        let mut stack = vec![(root, usize::MAX, 0)];
        while let Some((photo, parent, next)) = stack.last_mut() {
            let (photo, parent) = (*photo, *parent);
            if *next == 0 {
                self.order[photo] = self.members.len();
                self.low[photo] = self.members.len();
                self.members.push(photo);
            }
            if let Some((other, _)) = self.graph.partners[photo].get(*next) {
                *next += 1;
                if self.order[*other] == usize::MAX {
                    stack.push((*other, photo, 0));
                } else if *other != parent {
                    self.low[photo] = self.low[photo].min(self.order[*other]);
                }
                continue;
            }
            stack.pop();
            if parent != usize::MAX {
                self.low[parent] = self.low[parent].min(self.low[photo]);
                self.below[parent] += self.below[photo];
                done(self, parent, photo);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn graph(photos: usize, pairs: &[[usize; 2]]) -> Graph {
        let mut partners = vec![Vec::new(); photos];
        for (i, [a, b]) in pairs.iter().enumerate() {
            partners[*a].push((*b, i));
            partners[*b].push((*a, i));
        }
        Graph {
            partners,
            rigs: (0..photos).map(|photo| vec![photo]).collect(),
        }
    }

    /// All pairs among `photos`.
    fn clique(photos: std::ops::Range<usize>) -> Vec<[usize; 2]> {
        photos
            .clone()
            .flat_map(|a| photos.clone().filter(move |b| a < *b).map(move |b| [a, b]))
            .collect()
    }

    #[test]
    fn a_bridge_is_found_with_its_sides() {
        let pairs = [clique(0..4), clique(4..9), vec![[2, 6]]].concat();
        let found = weak_links(&graph(9, &pairs));
        assert_eq!(found.len(), 1, "{found:?}");
        assert!(
            matches!(
                &found[0],
                Diagnosis::Bridge {
                    photos: [2, 6],
                    sides: [4, 5]
                }
            ),
            "{found:?}"
        );
        let twice = [pairs, vec![[1, 7]]].concat();
        assert_eq!(weak_links(&graph(9, &twice)), []);
    }

    #[test]
    fn a_cut_point_is_found_with_the_smaller_part() {
        // Photograph 4 belongs to both groups.
        let pairs = [clique(0..5), clique(4..8)].concat();
        let found = weak_links(&graph(8, &pairs));
        let expected = Diagnosis::CutPoint {
            photo: 4,
            behind: vec![5, 6, 7],
        };
        assert_eq!(found, [expected]);
        assert_eq!(weak_links(&graph(6, &clique(0..6))), []);
        assert_eq!(weak_links(&graph(3, &[])), []);
    }

    #[test]
    fn parts_are_listed_largest_first() {
        let parts = graph(6, &[[0, 5], [1, 2], [2, 3]]).parts();
        assert_eq!(parts, [vec![1, 2, 3], vec![0, 5], vec![4]]);
    }
}
