//! Edges of a photograph: part of the saliency by which Taming 3DGS (Mallick et al. 2024) scores splats.

use crate::photos::Prepared;
use rayon::prelude::*;

/// Luma of ITU-R 601-2, by which the authors' code converts a photograph to grey.
const LUMA: [f32; 3] = [0.299, 0.587, 0.114];

/// Eight times each pixel's luma minus the sum of its eight neighbours' luma, clamped to \[0, 1\], `[H, W]`; 0 on the image's border.
pub(crate) fn edges(photo: &Prepared, edges: &mut Vec<f32>) {
    let (width, height) = (photo.width as usize, photo.height as usize);
    let luma = |x: usize, y: usize| {
        let at = 3 * (y * width + x);
        (0..3).map(|c| LUMA[c] * f32::from(photo.rgb[at + c])).sum::<f32>() * (1.0 / 255.0)
    };
    edges.clear();
    edges.resize(width * height, 0.0);
    if width < 3 || height < 3 {
        return;
    }
    let inner = edges.par_chunks_mut(width).enumerate().skip(1).take(height - 2);
    inner.for_each(|(y, row)| {
        for (x, edge) in row.iter_mut().enumerate().take(width - 1).skip(1) {
            let around = (y - 1..=y + 1).flat_map(|y| (x - 1..=x + 1).map(move |x| (x, y)));
            let sum: f32 = around.map(|(x, y)| luma(x, y)).sum();
            *edge = (9.0 * luma(x, y) - sum).clamp(0.0, 1.0);
        }
    });
}

/// The minimum of `values`, and the factor that scales their range to 1; 0 if they are all equal.
pub(crate) fn unit_range(values: &[f32]) -> [f32; 2] {
    let smallest = values.iter().copied().fold(f32::INFINITY, f32::min);
    let largest = values.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    let scale = if largest > smallest {
        1.0 / (largest - smallest)
    } else {
        0.0
    };
    [smallest, scale]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_edge_is_on_the_brighter_side_of_a_step() {
        let (width, height) = (8, 5);
        let rgb = (0..width * height)
            .flat_map(|i| [if i % 8 < 4 { 51 } else { 102 }; 3])
            .collect();
        let photo = Prepared {
            width,
            height,
            rgb,
            alpha: None,
            mask: None,
            background: [0.0; 3],
        };
        let mut found = Vec::new();
        edges(&photo, &mut found);
        // Three neighbours are darker by 0.2.
        for (i, edge) in found.iter().enumerate() {
            let inside = (8..32).contains(&i);
            let expected = if i % 8 == 4 && inside { 0.6 } else { 0.0 };
            assert!((edge - expected).abs() < 1e-5, "{i}: {edge}");
        }
        assert_eq!(unit_range(&found)[0], 0.0);
        assert_eq!(unit_range(&[0.25; 4]), [0.25, 0.0]);
    }
}
