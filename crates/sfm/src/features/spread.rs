//! Selection of features that cover the photograph, if there are too many.

/// Cells along the longer side of a photograph.
const GRID_CELLS: f32 = 16.0;
/// The fraction of `count` that is distributed evenly among the cells. With all of it distributed evenly, photographs of a street had
/// 40 % fewer verified matches: repeatable features are not spread evenly.
const EVEN_FRACTION: f32 = 0.25;

/// The indices of at most `count` of `places`, `[x, y, importance]` in a photograph of `size` pixels: the most important ones of each
/// cell of a grid, up to an even share, then the most important of the rest. Strong texture in one corner thus does not take the
/// features of other cells.
pub(super) fn select_spread(places: &[[f32; 3]], size: [usize; 2], count: usize) -> Vec<usize> {
    let side = size[0].max(size[1]) as f32 / GRID_CELLS;
    let columns = (size[0] as f32 / side).ceil() as usize;
    let rows = (size[1] as f32 / side).ceil() as usize;
    let cell = |i: usize| {
        let [x, y, _] = places[i].map(|v| (v / side) as usize);
        y.min(rows - 1) * columns + x.min(columns - 1)
    };
    let mut order: Vec<usize> = (0..places.len()).collect();
    order.sort_by(|a, b| places[*b][2].total_cmp(&places[*a][2]).then(a.cmp(b)));
    if order.len() <= count {
        return order;
    }
    let mut room = vec![(EVEN_FRACTION * count as f32 / (rows * columns) as f32) as u32; rows * columns];
    let (mut chosen, rest): (Vec<usize>, Vec<usize>) = order.into_iter().partition(|i| {
        let room = &mut room[cell(*i)];
        let has_room = *room > 0;
        *room = room.saturating_sub(1);
        has_room
    });
    chosen.extend(rest);
    chosen.truncate(count);
    chosen
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_crowded_corner_leaves_room_for_the_rest() {
        let mut places: Vec<[f32; 3]> = (0..2000).map(|i| [1.0 + 0.001 * i as f32, 1.0, 10.0]).collect();
        places.extend((0..16).map(|i| [5.0 + 10.0 * i as f32, 95.0, 0.01 * i as f32]));
        let chosen = select_spread(&places, [160, 100], 800);
        assert_eq!(chosen.len(), 800);
        assert!((2000..2016).all(|i| chosen.contains(&i)));
        // The rest is sorted by importance, equal ones by index.
        assert_eq!(chosen[799], 783);
        assert_eq!(select_spread(&places, [160, 100], 5000).len(), 2016);
    }
}
