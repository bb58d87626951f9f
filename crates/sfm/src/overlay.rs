//! What lies over all pictures at the same place, opaque or not: writing, logos, watermarks. Its edges are the same wherever the camera is, those of the scene
//! are not: the median of the gradients shows it alone (Dekel et al., *On the Effectiveness of Visible Watermarks*, 2017).

use crate::median;
use rayon::prelude::*;

/// Pictures from which on it can be told, and those that are looked at, at most, evenly chosen.
const FEWEST: usize = 8;
const LOOKED_AT: usize = 48;
/// Least slope of an edge, of 255 a pixel. Half-transparent white writing on a bright wall has 10 to 30; the medians of a scene that moves, less than 4.
const EDGE: f64 = 6.0;
/// Part of the pictures that have this edge, at least half as steep.
const AGREE: f64 = 0.8;
/// Edge pixels of a square of 5 by 5 around one, at least, itself included: single ones are chance.
const TOGETHER: usize = 5;
/// What is this near an edge, px, belongs to it: strokes are as thin.
const STROKE: usize = 3;

/// The pixels of `pictures`, `[H, W, 3]`, over which something lies in all of them; none where there are few.
pub fn overlay(width: usize, height: usize, pictures: &[&Vec<u8>]) -> Vec<bool> {
    let some: Vec<&[u8]> = (pictures.iter().step_by(pictures.len().div_ceil(LOOKED_AT).max(1)))
        .map(|picture| &picture[..])
        .collect();
    if some.len() < FEWEST {
        return vec![false; width * height];
    }
    let is_edge = |at: usize| {
        let (x, y) = (at % width, at / width);
        let is_inside = x > 0 && y > 0 && x + 1 < width && y + 1 < height;
        is_inside && (0..3).any(|c| is_shared(&some, at, width, c))
    };
    let edges: Vec<bool> = (0..width * height).into_par_iter().map(is_edge).collect();
    let around = |at: usize, reach: usize| {
        let (x, y) = (at % width, at / width);
        let rows = y.saturating_sub(reach)..(y + reach + 1).min(height);
        let columns = x.saturating_sub(reach)..(x + reach + 1).min(width);
        rows.flat_map(move |row| columns.clone().map(move |column| row * width + column))
    };
    let is_firm = |at: &usize| edges[*at] && around(*at, 2).filter(|near| edges[*near]).count() >= TOGETHER;
    let mut lies = vec![false; width * height];
    for at in (0..width * height).filter(is_firm) {
        around(at, STROKE).for_each(|near| lies[near] = true);
    }
    lies
}

/// Whether an edge of channel `c` at pixel `at` is in nearly all pictures.
fn is_shared(pictures: &[&[u8]], at: usize, width: usize, c: usize) -> bool {
    let slope = |picture: &[u8]| {
        let value = |at: usize| f64::from(picture[3 * at + c]);
        [value(at + 1) - value(at - 1), value(at + width) - value(at - width)].map(|difference| difference / 2.0)
    };
    let slopes: Vec<[f64; 2]> = pictures.iter().map(|picture| slope(picture)).collect();
    let middle = |axis: usize| median(slopes.iter().map(|slope| slope[axis]).collect()).unwrap_or(0.0);
    let [across, down] = [middle(0), middle(1)];
    let square = across * across + down * down;
    let agrees = |slope: &&[f64; 2]| slope[0] * across + slope[1] * down >= 0.5 * square;
    square >= EDGE * EDGE && slopes.iter().filter(agrees).count() as f64 >= AGREE * slopes.len() as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    const WIDTH: usize = 80;
    const HEIGHT: usize = 60;

    /// Pictures of a texture that moves by 7 px each, with white that lets 60 % of it through where `lies` says.
    fn pictures(lies: impl Fn(usize, usize) -> bool) -> Vec<Vec<u8>> {
        let picture = |i: usize| {
            let pixel = |at: usize| {
                let (x, y) = (at % WIDTH, at / WIDTH);
                let (u, v) = ((x + 7 * i) as f64, (y + 5 * i) as f64);
                let scene = 110.0 + 60.0 * (0.31 * u).sin() * (0.23 * v + 0.1 * i as f64).cos();
                let shown = if lies(x, y) { 255.0 * 0.4 + 0.6 * scene } else { scene };
                shown as u8
            };
            (0..WIDTH * HEIGHT).flat_map(|at| [pixel(at); 3]).collect()
        };
        (0..20).map(picture).collect()
    }

    fn found(lies: impl Fn(usize, usize) -> bool) -> Vec<bool> {
        let pictures = pictures(lies);
        overlay(WIDTH, HEIGHT, &pictures.iter().collect::<Vec<_>>())
    }

    #[test]
    fn strokes_are_found_whole_and_a_scene_that_moves_is_not() {
        let is_stroke = |x: usize, y: usize| {
            (20..60).contains(&x) && (30..34).contains(&y) || (40..44).contains(&x) && y > 20 && y < 50
        };
        let found_strokes = found(is_stroke);
        let count = |of: &dyn Fn(usize) -> bool| (0..WIDTH * HEIGHT).filter(|at| of(*at)).count();
        let stroke = |at: usize| is_stroke(at % WIDTH, at / WIDTH);
        assert_eq!(count(&|at| stroke(at) && !found_strokes[at]), 0, "missed");
        let far = |at: usize| {
            let (x, y) = (at % WIDTH, at / WIDTH);
            let near = |side: usize, of: usize| side.saturating_sub(6)..(side + 7).min(of);
            !near(y, HEIGHT).any(|row| near(x, WIDTH).any(|column| is_stroke(column, row)))
        };
        assert_eq!(count(&|at| far(at) && found_strokes[at]), 0, "found far from any");
        assert!(found(|_, _| false).iter().all(|lies| !lies));
    }
}
