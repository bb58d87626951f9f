//! The graph of overlap: parts, bridges, cut points and photographs with few partners.

use super::{Diagnosis, Evidence, Graph};

/// Minimum number of partners for a photograph to be well connected.
const MIN_PARTNERS: usize = 3;
/// Minimum number of photographs of a capture whose photographs can be expected to overlap more than once.
const MIN_CAPTURE_PHOTOS: usize = 6;
/// Minimum number of photographs of a part: fewer are reported as photographs with few partners.
const MIN_PART_PHOTOS: usize = 3;

/// All diagnoses about the graph of overlap.
pub(super) fn overlap(evidence: &Evidence, graph: &Graph) -> Vec<Diagnosis> {
    let mut found = Vec::new();
    let n = evidence.photos.len();
    if n < 2 {
        return found;
    }
    let parts: Vec<Vec<usize>> = graph
        .components()
        .into_iter()
        .filter(|part| part.len() >= MIN_PART_PHOTOS)
        .collect();
    if parts.len() > 1 {
        found.push(Diagnosis::SeparateParts { parts });
    }
    if n < MIN_CAPTURE_PHOTOS {
        return found;
    }
    // The faces of panoramas link the panoramas, so single pairs of faces would look like bridges.
    if !(0..n).any(|photo| graph.is_on_rig(photo)) {
        found.extend(weak_links(graph));
    }
    for photo in 0..n {
        let partners: Vec<usize> = graph.partners[photo].iter().map(|p| p.0).collect();
        if partners.len() < MIN_PARTNERS && !graph.is_on_rig(photo) {
            found.push(Diagnosis::FewPartners { photo, partners });
        }
    }
    found
}

/// Bridges and cut points (Tarjan 1972), where each side has at least [`MIN_PART_PHOTOS`] photographs.
fn weak_links(graph: &Graph) -> Vec<Diagnosis> {
    let n = graph.partners.len();
    let mut found = Vec::new();
    for component in graph.components() {
        let size = component.len();
        let mut search = DepthFirstSearch {
            graph,
            order: vec![usize::MAX; n],
            low: vec![usize::MAX; n],
            subtree_sizes: vec![1; n],
            members: Vec::new(),
        };
        search.visit(component[0], &mut |search, parent, child| {
            let (behind, rest) = (search.subtree_sizes[child], size - search.subtree_sizes[child]);
            if search.low[child] > search.order[parent] && behind >= MIN_PART_PHOTOS && rest >= MIN_PART_PHOTOS {
                found.push(Diagnosis::Bridge {
                    photos: [parent.min(child), parent.max(child)],
                    sides: [rest, behind],
                });
            } else if search.low[child] >= search.order[parent] && behind >= MIN_PART_PHOTOS && rest > MIN_PART_PHOTOS {
                // The parent belongs to neither side.
                let mut smaller_part: Vec<usize> = search.members[search.order[child]..].to_vec();
                if 2 * behind > size {
                    smaller_part = component
                        .iter()
                        .copied()
                        .filter(|p| *p != parent && !smaller_part.contains(p))
                        .collect();
                }
                smaller_part.sort_unstable();
                found.push(Diagnosis::CutPoint {
                    photo: parent,
                    behind: smaller_part,
                });
            }
        });
    }
    // The ends of a bridge are cut points too, and the root of the search is one for each of its branches.
    let mut reported: Vec<usize> = found
        .iter()
        .filter(|d| matches!(d, Diagnosis::Bridge { .. }))
        .flat_map(Diagnosis::photos)
        .collect();
    found.retain(|diagnosis| match diagnosis {
        Diagnosis::CutPoint { photo, .. } if reported.contains(photo) => false,
        Diagnosis::CutPoint { photo, .. } => {
            reported.push(*photo);
            true
        }
        _ => true,
    });
    found
}

/// Depth-first search.
struct DepthFirstSearch<'a> {
    graph: &'a Graph,
    /// `[photos]` position of each in the order in which they were reached.
    order: Vec<usize>,
    /// `[photos]` the earliest photograph that each and those below it lead to.
    low: Vec<usize>,
    /// `[photos]` number of photographs below each, including itself.
    subtree_sizes: Vec<usize>,
    /// Photographs in the order in which they were reached.
    members: Vec<usize>,
}

impl DepthFirstSearch<'_> {
    /// Calls `on_visited(search, parent, child)` when everything below `child` has been visited.
    fn visit(&mut self, root: usize, on_visited: &mut dyn FnMut(&Self, usize, usize)) {
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
                self.subtree_sizes[parent] += self.subtree_sizes[photo];
                on_visited(self, parent, photo);
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
        let parts = graph(6, &[[0, 5], [1, 2], [2, 3]]).components();
        assert_eq!(parts, [vec![1, 2, 3], vec![0, 5], vec![4]]);
    }
}
