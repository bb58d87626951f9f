//! Detection of what is laid over all photographs at the same position, opaque or not: text, logos, watermarks. Its edges are the same
//! wherever the camera is, those of the scene are not, so the median of the gradients shows only the overlay (Dekel et al., *On the
//! Effectiveness of Visible Watermarks*, 2017).

use crate::median;
use rayon::prelude::*;

/// Minimum number of photographs for a detection, and maximum number that are examined, evenly selected.
const MIN_PHOTOS: usize = 8;
const MAX_EXAMINED_PHOTOS: usize = 48;

/// Thresholds for an edge of an overlay.
#[derive(Clone, Copy)]
struct EdgeThresholds {
    /// Minimum slope, levels of 255 per pixel.
    min_slope: f64,
    /// Minimum fraction of the photographs that have this edge at least half as steep.
    min_agreement: f64,
}

/// Semi-transparent white text across a bright wall has slopes of 8 to 50.
const EDGE_THRESHOLDS: EdgeThresholds = EdgeThresholds {
    min_slope: 6.0,
    min_agreement: 0.8,
};
/// An edge that is hardly one of the scene, and the minimum fraction of pixels with such an edge for an overlay: 0.2 to 1.3 % with a
/// watermark, a date or a logo, 0.65 % in a drone's film with two; none in 16 captures without an overlay, except for three whose camera
/// hardly moves: 0.01 % (fern), 0.02 and 0.06 %.
const CERTAIN_EDGE_THRESHOLDS: EdgeThresholds = EdgeThresholds {
    min_slope: 10.0,
    min_agreement: 0.9,
};
const MIN_CERTAIN_FRACTION: f64 = 0.001;
/// Minimum number of edge pixels in the square of 5 x 5 around an edge pixel, itself included: single ones are coincidence.
const MIN_NEARBY_EDGES: usize = 5;
/// Pixels up to this distance from an edge belong to the overlay, px: strokes are as thin.
const DILATION_RADIUS: usize = 3;

/// Photographs from one camera that may have an overlay.
pub struct OverlayDetector<'a> {
    width: usize,
    height: usize,
    /// Some of the photographs, `[H, W, 3]`; empty if there are too few.
    pictures: Vec<&'a [u8]>,
}

impl<'a> OverlayDetector<'a> {
    /// An overlay detector for `pictures`, `[H, W, 3]`.
    pub fn new(width: usize, height: usize, pictures: &[&'a Vec<u8>]) -> Self {
        let examined = pictures
            .iter()
            .step_by(pictures.len().div_ceil(MAX_EXAMINED_PHOTOS).max(1));
        let examined = examined.filter(|_| pictures.len() >= MIN_PHOTOS);
        Self {
            width,
            height,
            pictures: examined.map(|picture| &picture[..]).collect(),
        }
    }

    /// Whether there is an overlay beyond doubt.
    pub fn is_certain(&self) -> bool {
        let edges = self
            .edges(CERTAIN_EDGE_THRESHOLDS)
            .into_iter()
            .filter(|edge| *edge)
            .count();
        edges as f64 >= MIN_CERTAIN_FRACTION * (self.width * self.height) as f64
    }

    /// `[H, W]` whether each pixel is covered by the overlay.
    pub fn mask(&self) -> Vec<bool> {
        let (width, height) = (self.width, self.height);
        let edges = self.edges(EDGE_THRESHOLDS);
        let around = |at: usize, reach: usize| {
            let (x, y) = (at % width, at / width);
            let rows = y.saturating_sub(reach)..(y + reach + 1).min(height);
            let columns = x.saturating_sub(reach)..(x + reach + 1).min(width);
            rows.flat_map(move |row| columns.clone().map(move |column| row * width + column))
        };
        let is_confirmed =
            |at: &usize| edges[*at] && around(*at, 2).filter(|near| edges[*near]).count() >= MIN_NEARBY_EDGES;
        let mut covered = vec![false; width * height];
        for at in (0..width * height).filter(is_confirmed) {
            around(at, DILATION_RADIUS).for_each(|near| covered[near] = true);
        }
        covered
    }

    /// `[H, W]` whether each pixel has such an edge.
    fn edges(&self, thresholds: EdgeThresholds) -> Vec<bool> {
        let is_edge = |at: usize| {
            let (x, y) = (at % self.width, at / self.width);
            let is_inside = x > 0 && y > 0 && x + 1 < self.width && y + 1 < self.height;
            is_inside && (0..3).any(|channel| self.has_edge(at, channel, thresholds))
        };
        (0..self.width * self.height).into_par_iter().map(is_edge).collect()
    }

    /// Whether there is such an edge in `channel` at pixel `at`.
    fn has_edge(&self, at: usize, channel: usize, thresholds: EdgeThresholds) -> bool {
        let slope = |picture: &[u8]| {
            let value = |at: usize| f64::from(picture[3 * at + channel]);
            let across = value(at + 1) - value(at - 1);
            let down = value(at + self.width) - value(at - self.width);
            [across, down].map(|difference| difference / 2.0)
        };
        let slopes: Vec<[f64; 2]> = self.pictures.iter().map(|picture| slope(picture)).collect();
        let median_slope = |axis: usize| median(slopes.iter().map(|slope| slope[axis]).collect()).unwrap_or(0.0);
        let [across, down] = [median_slope(0), median_slope(1)];
        let square = across * across + down * down;
        let agrees = |slope: &&[f64; 2]| slope[0] * across + slope[1] * down >= 0.5 * square;
        square >= thresholds.min_slope * thresholds.min_slope
            && slopes.iter().filter(agrees).count() as f64 >= thresholds.min_agreement * slopes.len() as f64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const WIDTH: usize = 80;
    const HEIGHT: usize = 60;

    /// Photographs of a texture that moves by 7 px each, covered by white that lets 60 % of it through where `is_covered` is true.
    fn pictures(is_covered: impl Fn(usize, usize) -> bool) -> Vec<Vec<u8>> {
        let picture = |i: usize| {
            let pixel = |at: usize| {
                let (x, y) = (at % WIDTH, at / WIDTH);
                let (u, v) = ((x + 7 * i) as f64, (y + 5 * i) as f64);
                let scene = 110.0 + 60.0 * (0.31 * u).sin() * (0.23 * v + 0.1 * i as f64).cos();
                let value = if is_covered(x, y) {
                    255.0 * 0.4 + 0.6 * scene
                } else {
                    scene
                };
                value as u8
            };
            (0..WIDTH * HEIGHT).flat_map(|at| [pixel(at); 3]).collect()
        };
        (0..20).map(picture).collect()
    }

    fn found(is_covered: impl Fn(usize, usize) -> bool) -> (bool, Vec<bool>) {
        let pictures = pictures(is_covered);
        let overlay = OverlayDetector::new(WIDTH, HEIGHT, &pictures.iter().collect::<Vec<_>>());
        (overlay.is_certain(), overlay.mask())
    }

    #[test]
    fn strokes_are_found_whole_and_a_scene_that_moves_is_not() {
        let is_stroke = |x: usize, y: usize| {
            (20..60).contains(&x) && (30..34).contains(&y) || (40..44).contains(&x) && y > 20 && y < 50
        };
        let (is_certain, found_strokes) = found(is_stroke);
        assert!(is_certain);
        let count = |of: &dyn Fn(usize) -> bool| (0..WIDTH * HEIGHT).filter(|at| of(*at)).count();
        let stroke = |at: usize| is_stroke(at % WIDTH, at / WIDTH);
        assert_eq!(count(&|at| stroke(at) && !found_strokes[at]), 0, "missed");
        let far = |at: usize| {
            let (x, y) = (at % WIDTH, at / WIDTH);
            let near = |side: usize, of: usize| side.saturating_sub(6)..(side + 7).min(of);
            !near(y, HEIGHT).any(|row| near(x, WIDTH).any(|column| is_stroke(column, row)))
        };
        assert_eq!(count(&|at| far(at) && found_strokes[at]), 0, "found far from any");
        let (is_certain, nothing) = found(|_, _| false);
        assert!(!is_certain && nothing.iter().all(|covered| !covered));
        let few: Vec<Vec<u8>> = pictures(is_stroke).into_iter().take(MIN_PHOTOS - 1).collect();
        assert!(!OverlayDetector::new(WIDTH, HEIGHT, &few.iter().collect::<Vec<_>>()).is_certain());
    }
}
