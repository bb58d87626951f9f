//! LPIPS as a loss, on the whole image or a part of it.
//!
//! The network evaluates two images forward and one backward, which makes this by far the most expensive loss; a random crop of
//! 128 x 128 pixels per step costs an eighth of a 270 x 480 image and has, except at the border, the same mean gradient.

use super::Target;
use crate::metric::{Lpips, LpipsError, Map, Network};
use crate::real::Real;
use irradia_scene::Rng;

/// A rectangle of pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Crop {
    /// First column.
    pub x: usize,
    /// First row.
    pub y: usize,
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
}

impl Crop {
    /// The whole image.
    pub fn whole(width: usize, height: usize) -> Self {
        Self {
            x: 0,
            y: 0,
            width,
            height,
        }
    }

    /// A random square of `side` pixels in the image, clipped to its size.
    pub fn random(width: usize, height: usize, side: usize, rng: &mut Rng) -> Self {
        let mut place = |length: usize| {
            let part = side.min(length);
            (rng.below((length - part + 1) as u32) as usize, part)
        };
        let ((x, width), (y, height)) = (place(width), place(height));
        Self { x, y, width, height }
    }
}

/// LPIPS of `render [3, stride]` within `crop`; `weight` times its gradient is added to `v_render`, of the same shape.
///
/// With a mask m in \[0, 1\] the render x is first replaced by `y + m (x - y)`, y being the truth.
///
/// # Errors
/// When a side of `crop` is below [`LpipsNet::min_side`](crate::LpipsNet::min_side).
///
/// # Panics
/// When a length does not match the target's size or `crop` exceeds the image: a bug in the caller.
pub fn perceptual(
    lpips: &Lpips,
    render: &[f32],
    target: &Target,
    crop: Crop,
    weight: f32,
    v_render: &mut [f32],
) -> Result<f64, LpipsError> {
    lpips.check_size(crop.width, crop.height)?;
    Ok(on_crop(
        &lpips.network,
        render,
        target,
        crop,
        f64::from(weight),
        v_render,
    ))
}

fn on_crop<T: Real>(
    network: &Network<T>,
    render: &[T],
    target: &Target<T>,
    crop: Crop,
    weight: f64,
    v_render: &mut [T],
) -> f64 {
    target.assert_lengths(render.len(), v_render.len());
    let inside = crop.x + crop.width <= target.width && crop.y + crop.height <= target.height;
    assert!(inside, "the crop lies within the image");
    let stride = render.len() / 3;
    let pixels = || (crop.y..crop.y + crop.height).flat_map(|y| (0..crop.width).map(move |x| (y, crop.x + x)));
    let at = |(y, x): (usize, usize)| y * target.width + x;
    let mask = |pixel: usize| {
        target
            .mask
            .map_or(T::one(), |m| T::from_f64(f64::from(m[pixel]) / 255.0))
    };
    let map = |data: Vec<T>| Map {
        height: crop.height,
        width: crop.width,
        channels: 3,
        data,
    };
    let truth: Vec<T> = pixels()
        .map(at)
        .flat_map(|pixel| std::array::from_fn::<T, 3, _>(|c| target.color(pixel, c)))
        .collect();
    let mut seen = truth.clone();
    for (pixel, color) in pixels().map(at).zip(seen.as_chunks_mut::<3>().0) {
        let m = mask(pixel);
        // A non-finite render must not pass through a weight of 0.
        if m > T::zero() {
            for (c, value) in color.iter_mut().enumerate() {
                *value += m * (render[c * stride + pixel] - *value);
            }
        }
    }
    let (distance, v) = network.distance_and_gradient(map(seen), map(truth));
    for (pixel, v) in pixels().map(at).zip(v.data.as_chunks::<3>().0) {
        let gain = T::from_f64(weight) * mask(pixel);
        if gain != T::zero() {
            for (c, v) in v.iter().enumerate() {
                v_render[c * stride + pixel] += gain * *v;
            }
        }
    }
    distance
}

#[cfg(test)]
mod tests {
    use super::super::Truth;
    use super::super::picture::Picture;
    use super::*;
    use irradia_testkit::finite_differences::check_directional;
    use irradia_testkit::shared;

    const WEIGHTS: &str = "data/lpips/lpips_squeeze.safetensors";

    fn evaluate(network: &Network<f64>, picture: &Picture, render: &[f64], crop: Crop) -> (f64, Vec<f64>) {
        let mut v_render = vec![0.0; render.len()];
        let distance = on_crop(network, render, &picture.target(), crop, 1.0, &mut v_render);
        (distance, v_render)
    }

    #[test]
    fn gradients_match_directional_finite_differences() {
        let Some(path) = shared(WEIGHTS) else { return };
        let network = Network::<f64>::load(&path).unwrap();
        let whole = |p: &Picture| Crop::whole(p.width, p.height);
        let part = |_: &Picture| Crop {
            x: 3,
            y: 2,
            width: 20,
            height: 19,
        };
        let crops: [&dyn Fn(&Picture) -> Crop; 2] = [&whole, &part];
        for (seed, (width, height)) in [(33, 24), (40, 37)].into_iter().enumerate() {
            for crop in crops {
                for masked in [false, true] {
                    let picture = Picture::random(width, height, masked, 70 + seed as u64);
                    let crop = crop(&picture);
                    let (_, v) = evaluate(&network, &picture, &picture.render, crop);
                    let value = |render: &[f64]| evaluate(&network, &picture, render, crop).0;
                    check_directional(&picture.render, &v, value, 1e-7, 1e-5);
                }
            }
        }
    }

    #[test]
    fn equal_images_have_no_gradient_and_descent_lowers_the_loss() {
        let Some(path) = shared(WEIGHTS) else { return };
        let lpips = Lpips::load(path).unwrap();
        let picture = Picture::random(48, 40, false, 5);
        let single = |v: &[f64]| v.iter().map(|v| *v as f32).collect::<Vec<f32>>();
        let (truth, mut render) = (single(&picture.truth), single(&picture.render));
        let target = Target {
            width: 48,
            height: 40,
            truth: Truth::Planar(&truth),
            mask: None,
        };
        let whole = Crop::whole(48, 40);
        let mut v = vec![0.0; truth.len()];
        assert_eq!(perceptual(&lpips, &truth, &target, whole, 1.0, &mut v).unwrap(), 0.0);
        assert!(v.iter().all(|v| *v == 0.0));

        let first = perceptual(&lpips, &render, &target, whole, 1.0, &mut v).unwrap();
        let mut last = first;
        for _ in 0..5 {
            let square: f32 = v.iter().map(|v| v * v).sum();
            // A step that would lower a linear loss by a fifth.
            let step = 0.2 * last as f32 / square;
            render.iter_mut().zip(&v).for_each(|(x, v)| *x -= step * v);
            v.fill(0.0);
            let now = perceptual(&lpips, &render, &target, whole, 1.0, &mut v).unwrap();
            assert!(now < last, "{now} after {last}");
            last = now;
        }
        assert!(last < 0.7 * first, "{first} to {last}");
    }

    #[test]
    fn the_loss_matches_the_metric_and_its_gradient_stays_in_the_crop() {
        let Some(path) = shared(WEIGHTS) else { return };
        let lpips = Lpips::load(path).unwrap();
        let picture = Picture::random(40, 30, false, 6);
        let single = |v: &[f64]| v.iter().map(|v| *v as f32).collect::<Vec<f32>>();
        let (truth, render) = (single(&picture.truth), single(&picture.render));
        let target = Target {
            width: 40,
            height: 30,
            truth: Truth::Planar(&truth),
            mask: None,
        };
        let mut v = vec![0.0; truth.len()];
        let got = perceptual(&lpips, &render, &target, Crop::whole(40, 30), 1.0, &mut v).unwrap();
        let want = lpips
            .distance(&picture.image(&picture.render), &picture.image(&picture.truth))
            .unwrap();
        assert!((got - want).abs() < 1e-6, "{got} {want}");

        let crop = Crop {
            x: 5,
            y: 4,
            width: 18,
            height: 20,
        };
        v.fill(0.0);
        perceptual(&lpips, &render, &target, crop, 1.0, &mut v).unwrap();
        for (i, v) in v.iter().enumerate() {
            let (x, y) = (i % 40, i / 40 % 30);
            let inside = (5..23).contains(&x) && (4..24).contains(&y);
            assert!(inside || *v == 0.0, "{x} {y}");
        }
        let small = Crop { width: 16, ..crop };
        let error = perceptual(&lpips, &render, &target, small, 1.0, &mut v).unwrap_err();
        assert!(error.to_string().contains("16x20"), "{error}");
    }

    #[test]
    fn results_do_not_depend_on_the_number_of_threads() {
        let Some(path) = shared(WEIGHTS) else { return };
        let lpips = Lpips::load(path).unwrap();
        let picture = Picture::random(70, 60, true, 7);
        let bytes = picture.image(&picture.truth).to_u8();
        let render: Vec<f32> = picture.render.iter().map(|v| *v as f32).collect();
        let target = Target {
            width: 70,
            height: 60,
            truth: Truth::Rgb8(&bytes),
            mask: picture.mask.as_deref(),
        };
        let run = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let mut v = vec![0.0; render.len()];
            let whole = Crop::whole(70, 60);
            let loss = pool.install(|| perceptual(&lpips, &render, &target, whole, 1.0, &mut v).unwrap());
            (loss, v)
        };
        let one = run(1);
        for threads in [2, 5] {
            assert_eq!(run(threads), one);
        }
    }

    #[test]
    fn random_crops_lie_within_the_image() {
        let mut rng = Rng::new(1, 0);
        for _ in 0..100 {
            let crop = Crop::random(70, 20, 32, &mut rng);
            assert_eq!((crop.width, crop.height, crop.y), (32, 20, 0));
            assert!(crop.x + crop.width <= 70);
        }
    }
}
