//! Bars at the borders of pictures: those of a film that was fitted into a frame of another shape.

use crate::median;

/// Distance from the bar's colour of a pixel of it, of 255, in each channel, at most.
const TOLERANCE: f64 = 12.0;
/// Part of a line's pixels that a bar has, in every picture.
const PLAIN: f64 = 0.99;
/// Part that the line behind its edge has, in half of the pictures, at most: what is dark or empty of its own ends elsewhere in each.
const BEHIND: f64 = 0.5;
/// Lines over which the edge of a bar is blurred, by scaling and by compression.
const BLURRED: usize = 3;
/// Lines of a bar, by the longer side, at least.
const LEAST: f64 = 0.006;

/// Widths of the bars to the left, above, to the right and below, px, in `pictures`, `[H, W, 3]`; 0 where there is none.
pub fn bars(width: usize, height: usize, pictures: &[&Vec<u8>]) -> [usize; 4] {
    let least = (LEAST * width.max(height) as f64).ceil() as usize;
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
        let share = |picture: &[u8], line: usize| {
            let near = |at: &usize| (0..3).all(|c| (pixel(picture, line, *at)[c] - colour[c]).abs() <= TOLERANCE);
            (0..length).filter(near).count() as f64 / length as f64
        };
        let is_plain = |line: &usize| pictures.iter().all(|picture| share(picture, *line) >= PLAIN);
        let depth = (0..lines / 2).take_while(is_plain).count();
        let behind = depth + BLURRED;
        let differs = |picture: &&&Vec<u8>| share(picture, behind) <= BEHIND;
        let has_edge = behind < lines && 2 * pictures.iter().filter(differs).count() >= pictures.len();
        if depth >= least && has_edge { depth } else { 0 }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Pictures of 100 x 80 with a pattern that differs, `dark` px of it black from the left.
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
        // Darkness that ends elsewhere in each picture, and a bar in some of them only.
        assert_eq!(found(|i| 20 + 8 * i), [0; 4]);
        assert_eq!(found(|i| 20 * (i % 2)), [0; 4]);
    }
}
