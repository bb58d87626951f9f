/// Resamples 8-bit pixels `from [height, width, channels]`, `size` being `[width, height]`, to exactly `to` by area: an output
/// pixel is the mean of the input it covers, partly covered pixels weighted by their fraction. Values are averaged as stored
/// (sRGB); with 4 channels colour is weighted by alpha, so that transparent pixels do not bleed into edges. Enlarging
/// repeats pixels.
///
/// # Panics
/// When the length does not match, a size is zero, or the channels are not 1, 3 or 4.
pub fn resize_area(from: &[u8], channels: u32, size: [u32; 2], to: [u32; 2]) -> Vec<u8> {
    resize_part(from, channels, size, Part::whole(size), to)
}

/// A rectangle of an image, pixels; its edges may lie within pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Part {
    /// Left and upper edge.
    pub start: [f64; 2],
    /// Width and height.
    pub size: [f64; 2],
}

impl Part {
    /// All of an image of `size`.
    pub fn whole(size: [u32; 2]) -> Self {
        Self {
            start: [0.0; 2],
            size: size.map(f64::from),
        }
    }
}

/// Like [`resize_area`], but of a part of the image.
///
/// # Panics
/// As [`resize_area`].
pub fn resize_part(from: &[u8], channels: u32, size: [u32; 2], part: Part, to: [u32; 2]) -> Vec<u8> {
    let channels = channels as usize;
    assert_eq!(
        from.len(),
        size[0] as usize * size[1] as usize * channels,
        "pixel data matches the size"
    );
    assert!(!size.contains(&0) && !to.contains(&0), "sizes are positive");
    let [across, down] = [0, 1].map(|axis| spans(size[axis], part.start[axis], part.size[axis], to[axis]));
    let stride = size[0] as usize * channels;
    let mut data = Vec::with_capacity(to[0] as usize * to[1] as usize * channels);
    let mut sums = vec![0f32; to[0] as usize * channels];
    for span in &down {
        sums.fill(0.0);
        for (row, weight) in span.weights() {
            let row = &from[row * stride..(row + 1) * stride];
            match channels {
                1 => add_row::<1>(&mut sums, row, &across, weight),
                3 => add_row::<3>(&mut sums, row, &across, weight),
                4 => add_row::<4>(&mut sums, row, &across, weight),
                _ => panic!("1, 3 or 4 channels"),
            }
        }
        // Rounding: `as u8` truncates and saturates.
        if channels == 4 {
            for pixel in sums.chunks_exact(4) {
                let alpha = pixel[3];
                let scale = if alpha > 0.0 { 255.0 / alpha } else { 0.0 };
                data.extend(pixel[..3].iter().map(|v| (v * scale + 0.5) as u8));
                data.push((alpha + 0.5) as u8);
            }
        } else {
            data.extend(sums.iter().map(|v| (v + 0.5) as u8));
        }
    }
    data
}

/// Adds a row, averaged horizontally and scaled by `weight`; with 4 channels colour is premultiplied by alpha / 255.
fn add_row<const C: usize>(sums: &mut [f32], row: &[u8], across: &[Span], weight: f32) {
    for (sum, span) in sums.chunks_exact_mut(C).zip(across) {
        for (x, fraction) in span.weights() {
            let pixel: &[u8; C] = row[x * C..(x + 1) * C].try_into().expect("C values");
            let fraction = fraction * weight;
            let color_fraction = if C == 4 {
                fraction * f32::from(pixel[3]) * (1.0 / 255.0)
            } else {
                fraction
            };
            for c in 0..C {
                sum[c] += f32::from(pixel[c]) * if c < 3 { color_fraction } else { fraction };
            }
        }
    }
}

/// The source pixels that one output pixel covers along one axis, as a weighted mean.
struct Span {
    first: usize,
    last: usize,
    first_weight: f32,
    inner_weight: f32,
    last_weight: f32,
}

impl Span {
    fn weights(&self) -> impl Iterator<Item = (usize, f32)> {
        (self.first..=self.last).map(|i| {
            let weight = if i == self.first {
                self.first_weight
            } else if i == self.last {
                self.last_weight
            } else {
                self.inner_weight
            };
            (i, weight)
        })
    }
}

/// The spans of `to` output pixels, which cover `length` of the `from` source pixels, starting at `begin`.
fn spans(from: u32, begin: f64, length: f64, to: u32) -> Vec<Span> {
    let scale = length / f64::from(to);
    (0..to)
        .map(|i| {
            let (start, end) = (begin + f64::from(i) * scale, begin + f64::from(i + 1) * scale);
            let first = (start as usize).min(from as usize - 1);
            // An end on a pixel border, up to rounding, belongs to the previous pixel.
            let last = ((end - 1e-6).max(start) as usize).clamp(first, from as usize - 1);
            let fraction = |pixel: usize| {
                let overlap = end.min(pixel as f64 + 1.0) - start.max(pixel as f64);
                (overlap / scale) as f32
            };
            Span {
                first,
                last,
                first_weight: if first == last { 1.0 } else { fraction(first) },
                inner_weight: (1.0 / scale) as f32,
                last_weight: fraction(last),
            }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn averages_whole_and_partial_pixels() {
        assert_eq!(
            resize_area(&[0, 100, 40, 40, 100, 200, 40, 80], 1, [4, 2], [2, 1]),
            [100, 50]
        );
        // 3 -> 2: each output covers one pixel and half of the middle one.
        assert_eq!(resize_area(&[90, 30, 0], 1, [3, 1], [2, 1]), [70, 10]);
        let constant = resize_area(&vec![77; 541 * 37], 1, [541, 37], [200, 13]);
        assert!(constant.iter().all(|v| *v == 77));
        assert_eq!(
            resize_area(&[10, 20], 1, [2, 1], [4, 2]),
            [10, 10, 20, 20, 10, 10, 20, 20]
        );
    }

    #[test]
    fn a_part_may_begin_and_end_within_pixels() {
        let part = |start: f64, size: f64| Part {
            start: [start, 0.0],
            size: [size, 1.0],
        };
        let row = [80, 40, 0, 200];
        assert_eq!(resize_part(&row, 1, [4, 1], part(0.5, 2.0), [1, 1]), [40]);
        assert_eq!(resize_part(&row, 1, [4, 1], part(0.5, 3.0), [3, 1]), [60, 20, 100]);
        assert_eq!(resize_part(&row, 1, [4, 1], part(1.0, 2.5), [1, 1]), [56]);
    }

    #[test]
    fn transparent_pixels_contribute_no_colour() {
        let two = [200, 100, 50, 255, 0, 255, 0, 0];
        assert_eq!(resize_area(&two, 4, [2, 1], [1, 1]), [200, 100, 50, 128]);
    }
}
