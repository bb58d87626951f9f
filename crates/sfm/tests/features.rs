//! SIFT on photographs with known features: blobs, and the same texture seen from another viewpoint.

use irradia_compute::Level;
use irradia_scene::Rng;
use irradia_sfm::features::{Extractor, GreyPhoto, Sift};
use irradia_sfm::matching::{MatchOptions, match_features, match_pairs};
use irradia_sfm::{Features, Keypoint};
use std::f32::consts::{FRAC_PI_2, TAU};

struct Picture {
    width: u32,
    height: u32,
    data: Vec<u8>,
}

impl Picture {
    /// Samples `shade`, with values in \[0, 1\], at the centres of the pixels.
    fn new(width: u32, height: u32, shade: impl Fn(f64, f64) -> f64) -> Self {
        let pixel = |i: u32| shade(f64::from(i % width) + 0.5, f64::from(i / width) + 0.5);
        Self {
            width,
            height,
            data: (0..width * height).map(|i| (255.0 * pixel(i) + 0.5) as u8).collect(),
        }
    }

    fn photo(&self) -> GreyPhoto<'_> {
        GreyPhoto {
            width: self.width,
            height: self.height,
            data: &self.data,
            mask: None,
        }
    }

    fn features(&self) -> Features {
        Sift::default().extract(&self.photo())
    }
}

/// Blobs with random positions, sizes, shapes and shades, as a function of position.
fn texture(size: f64) -> impl Fn(f64, f64) -> f64 {
    let mut rng = Rng::new(7, 0);
    let mut uniform = move |from: f64, to: f64| from + (to - from) * f64::from(rng.uniform());
    let blobs: Vec<[f64; 7]> = (0..500)
        .map(|_| {
            let [x, y] = [(); 2].map(|()| uniform(-0.1, 1.1) * size);
            let (long, thin) = (uniform(1.2, 9.0), uniform(0.6, 1.0));
            let (sin, cos) = uniform(0.0, 6.3).sin_cos();
            [x, y, long, long * thin, sin, cos, uniform(-0.4, 0.4)]
        })
        .collect();
    move |x, y| {
        let shade = |[bx, by, long, short, sin, cos, height]: &[f64; 7]| {
            let (dx, dy) = (x - bx, y - by);
            let (u, v) = ((cos * dx + sin * dy) / long, (cos * dy - sin * dx) / short);
            let q = u * u + v * v;
            if q < 30.0 { height * (-0.5 * q).exp() } else { 0.0 }
        };
        (0.5 + blobs.iter().map(shade).sum::<f64>()).clamp(0.0, 1.0)
    }
}

#[test]
fn a_blob_is_found_at_its_place_and_scale() {
    for (x, y, sigma) in [(60.3f64, 55.8f64, 2.5f64), (64.1, 61.2, 5.0), (70.6, 66.1, 10.0)] {
        let blob =
            |px: f64, py: f64| 0.2 + 0.6 * (-((px - x).powi(2) + (py - y).powi(2)) / (2.0 * sigma * sigma)).exp();
        let features = Picture::new(130, 120, blob).features();
        // No direction dominates, so there may be several features at the same position, and some on the dark ring around it.
        let distance = |k: &Keypoint| (f64::from(k.x) - x).hypot(f64::from(k.y) - y);
        let at_centre: Vec<&Keypoint> = features.keypoints.iter().filter(|k| distance(k) < sigma).collect();
        assert!(!at_centre.is_empty(), "sigma {sigma}");
        for keypoint in at_centre {
            assert!(distance(keypoint) < 0.03 * sigma, "sigma {sigma}: {keypoint:?}");
            // The difference of Gaussians of sigma and k sigma at a blob's centre is largest where k sigma^2 is the blob's variance;
            // half a pixel of blur is attributed to the camera. The quadratic fit in scale is off by a few per cent.
            let expected = ((sigma * sigma - 0.25) / 2f64.powf(1.0 / 3.0)).sqrt();
            let ratio = f64::from(keypoint.scale) / expected;
            assert!(
                (0.95..1.05).contains(&ratio),
                "sigma {sigma}: {keypoint:?}, expected {expected}"
            );
        }
    }
}

#[test]
fn a_photograph_turned_by_90_degrees_has_the_same_features() {
    let side = 256;
    let shade = texture(f64::from(side));
    let upright = Picture::new(side, side, &shade).features();
    // What was at (y, side - x) is at (x, y).
    let turned = Picture::new(side, side, |x, y| shade(y, f64::from(side) - x)).features();
    assert!(upright.keypoints.len() > 200, "{}", upright.keypoints.len());
    let is_repeated = |(keypoint, descriptor): &(&Keypoint, &[u8; 128])| {
        let place = [side as f32 - keypoint.y, keypoint.x];
        turned.keypoints.iter().zip(&turned.descriptors).any(|(other, bytes)| {
            let turn = (other.angle - keypoint.angle).rem_euclid(TAU);
            (other.x - place[0]).hypot(other.y - place[1]) < 0.01
                && (other.scale / keypoint.scale - 1.0).abs() < 1e-3
                && (turn - FRAC_PI_2).abs() < 1e-2
                && bytes.iter().zip(*descriptor).all(|(a, b)| a.abs_diff(*b) <= 3)
        })
    };
    let repeated = upright
        .keypoints
        .iter()
        .zip(&upright.descriptors)
        .filter(is_repeated)
        .count();
    // Sums are rounded in another order, which moves a few across a threshold.
    let fraction = repeated as f64 / upright.keypoints.len() as f64;
    assert!(fraction > 0.99, "{fraction}");
}

#[test]
fn a_tilted_view_matches_as_it_looks_from_the_front() {
    let shade = texture(300.0);
    let frontal = Sift {
        frontal: true,
        ..Sift::default()
    };
    let [upright, tilted] = [
        Picture::new(300, 300, &shade),
        // Tilted by 70 degrees from the frontal view: a third of the width remains.
        Picture::new(100, 300, |x, y| shade(3.0 * x, y)),
    ]
    .map(|picture| frontal.extract(&picture.photo()));
    let right = |matches: Vec<[u32; 2]>| {
        let is_right = |m: &&[u32; 2]| {
            let (a, b) = (&upright.keypoints[m[0] as usize], &tilted.keypoints[m[1] as usize]);
            (a.x - 3.0 * b.x).abs() < 9.0 && (a.y - b.y).abs() < 3.0
        };
        (matches.iter().filter(is_right).count(), matches.len())
    };
    let options = MatchOptions::default();
    let usual = |features: &Features| Features {
        frontal: Vec::new(),
        ..features.clone()
    };
    let (without, _) = right(match_features(&usual(&upright), &usual(&tilted), &options));
    let (with, all) = right(match_features(&upright, &tilted, &options));
    assert!(with >= 20 + 3 * without, "{with} right matches, without {without}");
    assert!(10 * with >= 9 * all, "{with} of {all} are right");
    // If one of the photographs has no frontal descriptors, the usual matches stay.
    assert!(
        !usual(&upright).keypoints.is_empty()
            && right(match_features(&upright, &usual(&tilted), &options)).0 == without
    );
}

#[test]
fn a_turned_and_enlarged_photograph_has_its_features_at_the_mapped_places() {
    let shade = texture(300.0);
    let upright = Picture::new(300, 300, &shade).features();
    let (sin, cos) = 0.55f64.sin_cos();
    let enlarged = 1.4;
    // Rotated about the centres of both photographs.
    let picture = Picture::new(420, 420, |x, y| {
        let (dx, dy) = ((x - 210.0) / enlarged, (y - 210.0) / enlarged);
        shade(150.0 + cos * dx + sin * dy, 150.0 - sin * dx + cos * dy)
    });
    let other = picture.features();
    let mapped = |k: &Keypoint| {
        let (dx, dy) = (enlarged * f64::from(k.x - 150.0), enlarged * f64::from(k.y - 150.0));
        [210.0 + cos * dx - sin * dy, 210.0 + sin * dx + cos * dy]
    };
    let is_inside = |[x, y]: [f64; 2]| (20.0..400.0).contains(&x) && (20.0..400.0).contains(&y);
    let distance = |k: &Keypoint, other: &Keypoint| {
        let [x, y] = mapped(k);
        (x - f64::from(other.x)).hypot(y - f64::from(other.y))
    };
    let visible: Vec<&Keypoint> = upright.keypoints.iter().filter(|k| is_inside(mapped(k))).collect();
    let repeated = visible.iter().filter(|k| {
        let agrees = |o: &Keypoint| distance(k, o) < 1.0 && (o.scale / (k.scale * 1.4) - 1.0).abs() < 0.2;
        other.keypoints.iter().any(agrees)
    });
    let repeatability = repeated.count() as f64 / visible.len() as f64;
    assert!(
        visible.len() > 150 && repeatability > 0.85,
        "{repeatability} of {}",
        visible.len()
    );
    let matches = match_features(&upright, &other, &MatchOptions::default());
    let is_right = |m: &&[u32; 2]| {
        let (a, b) = (&upright.keypoints[m[0] as usize], &other.keypoints[m[1] as usize]);
        distance(a, b) < 1.0 + 0.2 * f64::from(b.scale)
    };
    let right = matches.iter().filter(is_right).count();
    assert!(
        matches.len() > visible.len() / 2,
        "{} matches of {}",
        matches.len(),
        visible.len()
    );
    assert!(
        right as f64 > 0.98 * matches.len() as f64,
        "{right} of {}",
        matches.len()
    );
}

#[test]
fn every_instruction_set_and_number_of_threads_gives_the_same_bytes() {
    let shade = texture(200.0);
    let pictures = [0.0, 15.0, 30.0].map(|shift| Picture::new(203, 190, |x, y| shade(x + shift, y)));
    let results: Vec<_> = Level::all()
        .into_iter()
        .flat_map(|level| [1, 3].map(|threads| (level, threads)))
        .map(|(level, threads)| {
            let sift = Sift {
                level,
                ..Sift::default()
            };
            let features: Vec<Features> = pictures.iter().map(|picture| sift.extract(&picture.photo())).collect();
            let options = MatchOptions {
                level,
                ..MatchOptions::default()
            };
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let matches = pool.install(|| match_pairs(&features, &[[0, 1], [0, 2], [1, 2]], &options, || {}));
            (features, matches)
        })
        .collect();
    assert!(results[0].1.iter().all(|pair| pair.matches.len() > 50));
    assert!(results.iter().all(|result| *result == results[0]));
}

#[test]
fn masks_limits_and_reduced_sizes_are_respected() {
    let picture = Picture::new(240, 200, texture(240.0));
    let all = picture.features();
    let mask: Vec<u8> = (0..240 * 200).map(|i| if i % 240 < 120 { 0 } else { 255 }).collect();
    let masked = Sift::default().extract(&GreyPhoto {
        mask: Some(&mask),
        ..picture.photo()
    });
    let right: Vec<&Keypoint> = all.keypoints.iter().filter(|k| k.x >= 120.0).collect();
    assert_eq!(masked.keypoints.iter().collect::<Vec<_>>(), right);
    let few = Sift {
        max_features: 50,
        ..Sift::default()
    }
    .extract(&picture.photo());
    assert_eq!(few.keypoints.len(), 50);
    assert!(few.keypoints.iter().all(|k| all.keypoints.contains(k)));
    assert!(few.keypoints.is_sorted_by(|a, b| a.scale >= b.scale));
    // A photograph whose pixels are repeated 2 x 2 is the same when reduced again; positions are those in the large one.
    let large = Picture::new(480, 400, |x, y| {
        f64::from(picture.data[(y / 2.0) as usize * 240 + (x / 2.0) as usize]) / 255.0
    });
    let reduced = Sift {
        max_side: 240,
        ..Sift::default()
    }
    .extract(&large.photo());
    assert_eq!(reduced.descriptors, all.descriptors);
    let is_doubled = |(a, b): (&Keypoint, &Keypoint)| [2.0 * a.x, 2.0 * a.y, 2.0 * a.scale] == [b.x, b.y, b.scale];
    assert!(all.keypoints.iter().zip(&reduced.keypoints).all(is_doubled));
}

#[test]
fn tiny_flat_and_noisy_pictures_are_no_trouble() {
    for (width, height) in [(0, 0), (1, 1), (7, 3), (8, 8), (9, 200), (33, 17)] {
        let mut rng = Rng::new(3, 0);
        let noise: Vec<u8> = (0..width * height).map(|_| rng.below(256) as u8).collect();
        let flat = vec![200; noise.len()];
        for (data, is_flat) in [(noise, false), (flat, true)] {
            let features = Sift::default().extract(&GreyPhoto {
                width,
                height,
                data: &data,
                mask: None,
            });
            let is_inside = |k: &Keypoint| {
                (0.0..=width as f32).contains(&k.x)
                    && (0.0..=height as f32).contains(&k.y)
                    && k.scale > 0.0
                    && k.angle.is_finite()
            };
            assert!(features.keypoints.iter().all(is_inside), "{width}x{height}");
            assert!(!is_flat || features.keypoints.is_empty(), "{width}x{height}");
        }
    }
}
