//! Exact nearest neighbours of points in space: an implicit k-d tree (Bentley 1975), stored as an order of the points.

/// Number of points up to which a subtree is searched linearly.
const LEAF_SIZE: usize = 12;

/// Points `[N, 3]`, all finite, in the order of a balanced k-d tree: the median of each subtree splits the rest along one axis.
pub struct Nearest {
    points: Vec<([f32; 3], u32)>,
}

/// A neighbour: its squared distance and its index.
pub type Neighbour = (f32, u32);

impl Nearest {
    /// The tree of `positions`.
    pub fn new(positions: &[[f32; 3]]) -> Self {
        let mut points: Vec<_> = positions.iter().copied().zip(0..).collect();
        arrange(&mut points, 0);
        Self { points }
    }

    /// The K points nearest to `at`, which may be one of them, by distance; ties are broken arbitrarily. If there are fewer than
    /// K points, the rest are at an infinite distance.
    pub fn of<const K: usize>(&self, at: [f32; 3]) -> [Neighbour; K] {
        let mut best = [(f32::INFINITY, u32::MAX); K];
        search(&self.points, 0, at, &mut best);
        best
    }
}

fn arrange(points: &mut [([f32; 3], u32)], axis: usize) {
    if points.len() <= LEAF_SIZE {
        return;
    }
    let middle = points.len() / 2;
    points.select_nth_unstable_by(middle, |(a, _), (b, _)| a[axis].total_cmp(&b[axis]));
    let (low, high) = points.split_at_mut(middle);
    let axis = (axis + 1) % 3;
    rayon::join(|| arrange(low, axis), || arrange(&mut high[1..], axis));
}

fn search<const K: usize>(points: &[([f32; 3], u32)], axis: usize, at: [f32; 3], best: &mut [Neighbour; K]) {
    if points.len() <= LEAF_SIZE {
        for point in points {
            insert(point, at, best);
        }
        return;
    }
    let middle = points.len() / 2;
    let apart = at[axis] - points[middle].0[axis];
    let (low, high) = (&points[..middle], &points[middle + 1..]);
    let (same, other) = if apart < 0.0 { (low, high) } else { (high, low) };
    let axis = (axis + 1) % 3;
    search(same, axis, at, best);
    insert(&points[middle], at, best);
    // Rounding is monotone: no point beyond the plane has a smaller squared distance, in f32, than this. Points at an equal
    // distance are not searched, otherwise queries on many coincident points would each visit all of them.
    if apart * apart < best[K - 1].0 {
        search(other, axis, at, best);
    }
}

fn insert<const K: usize>((point, index): &([f32; 3], u32), at: [f32; 3], best: &mut [Neighbour; K]) {
    let [x, y, z] = [0, 1, 2].map(|c| (at[c] - point[c]) * (at[c] - point[c]));
    let new = (x + y + z, *index);
    let mut place = K;
    while place > 0 && new.0 < best[place - 1].0 {
        place -= 1;
    }
    if place < K {
        best[place..].rotate_right(1);
        best[place] = new;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use irradia_scene::Rng;

    fn square(a: [f32; 3], b: [f32; 3]) -> f32 {
        (0..3).map(|c| (a[c] - b[c]) * (a[c] - b[c])).sum()
    }

    #[test]
    fn neighbours_match_an_exhaustive_search() {
        let mut rng = Rng::new(5, 0);
        // A cloud, a plane, a line with many coincident points, a grid of equal distances, and distant coordinates.
        type Make<'a> = &'a dyn Fn(&mut Rng, usize) -> [f32; 3];
        let kinds: [Make; 5] = [
            &|rng, _| std::array::from_fn(|_| rng.normal()),
            &|rng, _| [rng.normal(), rng.normal(), 2.0],
            &|rng, _| [rng.below(7) as f32, 0.0, 0.0],
            &|_, i| [(i % 9) as f32, (i / 9 % 9) as f32, (i / 81) as f32],
            &|rng, _| std::array::from_fn(|_| 1e6 + rng.normal()),
        ];
        for make in kinds {
            for n in [1, 3, LEAF_SIZE + 1, 700] {
                let positions: Vec<[f32; 3]> = (0..n).map(|i| make(&mut rng, i)).collect();
                let tree = Nearest::new(&positions);
                for at in positions.iter().take(100) {
                    let mut want: Vec<f32> = positions.iter().map(|p| square(*at, *p)).collect();
                    want.sort_by(f32::total_cmp);
                    let got = tree.of::<4>(*at);
                    let (found, missing) = got.split_at(n.min(4));
                    assert_eq!(found.iter().map(|n| n.0).collect::<Vec<_>>(), want[..found.len()]);
                    assert!(found.iter().all(|(d, i)| square(*at, positions[*i as usize]) == *d));
                    assert!((1..found.len()).all(|i| found[..i].iter().all(|n| n.1 != found[i].1)));
                    assert!(missing.iter().all(|(distance, _)| distance.is_infinite()));
                }
            }
        }
    }
}
