//! Bars at the borders of photographs: letterboxing and pillarboxing of a film that was fitted into a frame of another shape.

use crate::median;

/// Maximum difference of a bar's pixel from the bar's colour in each channel, of 255.
const MAX_COLOR_DIFFERENCE: f64 = 12.0;
/// Minimum fraction of a line's pixels that have the bar's colour, in every photograph.
const MIN_BAR_FRACTION: f64 = 0.99;
/// Maximum such fraction of the line behind the bar's edge, in at least half of the photographs: dark or empty parts of the scene
/// end elsewhere in each photograph.
const MAX_INNER_FRACTION: f64 = 0.5;
/// Lines over which the edge of a bar is blurred, by scaling and by compression.
const BLURRED_LINES: usize = 3;
/// Minimum width of a bar, relative to the longer side.
const MIN_BAR_WIDTH: f64 = 0.006;

/// Widths of the left, top, right and bottom bars of `pictures`, `[H, W, 3]`, px; 0 where there is no bar.
pub fn bars(width: usize, height: usize, pictures: &[&Vec<u8>]) -> [usize; 4] {
    let min_width = (MIN_BAR_WIDTH * width.max(height) as f64).ceil() as usize;
    [0, 1, 2, 3].map(|side| {
        let is_column = side % 2 == 0;
        let (lines, length) = if is_column { (width, height) } else { (height, width) };
        let pixel = |picture: &[u8], line: usize, along: usize| {
            let line = if side < 2 { line } else { lines - 1 - line };
            let at = if is_column {
                along * width + line
            } else {
                line * width + along
            };
            [0, 1, 2].map(|c| f64::from(picture[3 * at + c]))
        };
        let outermost = |channel: usize| {
            let values = pictures
                .iter()
                .flat_map(|picture| (0..length).map(move |along| (picture, along)));
            median(
                values
                    .map(|(picture, along)| pixel(picture, 0, along)[channel])
                    .collect(),
            )
            .unwrap_or(0.0)
        };
        let colour = [0, 1, 2].map(outermost);
        let bar_fraction = |picture: &[u8], line: usize| {
            let near =
                |at: &usize| (0..3).all(|c| (pixel(picture, line, *at)[c] - colour[c]).abs() <= MAX_COLOR_DIFFERENCE);
            (0..length).filter(near).count() as f64 / length as f64
        };
        let is_bar = |line: &usize| {
            pictures
                .iter()
                .all(|picture| bar_fraction(picture, *line) >= MIN_BAR_FRACTION)
        };
        let depth = (0..lines / 2).take_while(is_bar).count();
        let inner = depth + BLURRED_LINES;
        let differs = |picture: &&&Vec<u8>| bar_fraction(picture, inner) <= MAX_INNER_FRACTION;
        let has_edge = inner < lines && 2 * pictures.iter().filter(differs).count() >= pictures.len();
        if depth >= min_width && has_edge { depth } else { 0 }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Photographs of 100 x 80 px, each with its own pattern, whose leftmost `dark` px are black.
    fn pictures(dark: impl Fn(usize) -> usize) -> Vec<Vec<u8>> {
        let picture = |i: usize| {
            let pixel = |at: usize| {
                let (x, y) = (at % 100, at / 100);
                if x < dark(i) {
                    3
                } else {
                    (40 + (x * 7 + y * 13 + i * 31) % 200) as u8
                }
            };
            (0..100 * 80).flat_map(|at| [pixel(at); 3]).collect()
        };
        (0..6).map(picture).collect()
    }

    fn found(dark: impl Fn(usize) -> usize) -> [usize; 4] {
        let pictures = pictures(dark);
        bars(100, 80, &pictures.iter().collect::<Vec<_>>())
    }

    #[test]
    fn bars_end_at_the_same_line_in_all_pictures() {
        assert_eq!(found(|_| 20), [20, 0, 0, 0]);
        assert_eq!(found(|_| 0), [0; 4]);
        // A dark part that ends elsewhere in each photograph, and a bar in only some of them.
        assert_eq!(found(|i| 20 + 8 * i), [0; 4]);
        assert_eq!(found(|i| 20 * (i % 2)), [0; 4]);
    }
}
