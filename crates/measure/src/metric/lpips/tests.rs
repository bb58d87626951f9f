//! Whole networks with random weights, against independent code.

use super::layers::Map;
use super::net::LpipsNet;
use super::network::Network;
use super::weights::{ImportedTensor, LpipsError, Tensors, heads, to_weights_file};
use super::{Lpips, map_of};
use crate::metric::lpips::backbone::Backbone;
use irradia_scene::{Image, Rng};
use irradia_testkit::finite_differences::check_directional;
use std::cell::RefCell;
use std::collections::BTreeMap;

/// Provides random tensors of any shape, scaled such that features keep their variance (He et al. 2015).
struct RandomTensors {
    rng: RefCell<Rng>,
    tensors: RefCell<BTreeMap<String, ImportedTensor>>,
}

impl Tensors for RandomTensors {
    fn tensor(&self, name: &str, shape: &[usize]) -> Result<Vec<f32>, LpipsError> {
        let mut rng = self.rng.borrow_mut();
        let n: usize = shape.iter().product();
        let scale = (2.0 / shape[1..].iter().product::<usize>() as f32).sqrt();
        let mut tensors = self.tensors.borrow_mut();
        let tensor = tensors.entry(name.to_owned()).or_insert_with(|| ImportedTensor {
            shape: shape.to_vec(),
            values: (0..n)
                .map(|_| match name {
                    _ if name.starts_with("lin") => rng.uniform(),
                    _ if name.ends_with("bias") => 0.1 * rng.normal(),
                    // Uniform with the variance of a normal variate at a tenth of its cost: VGG has 15 million weights.
                    _ => 1.7 * scale * rng.range(-1.0, 1.0),
                })
                .collect(),
        });
        Ok(tensor.values.clone())
    }
}

fn random_tensors(net: LpipsNet) -> BTreeMap<String, ImportedTensor> {
    let made_up = RandomTensors {
        rng: RefCell::new(Rng::new(4, 0)),
        tensors: RefCell::default(),
    };
    Backbone::<f32>::from_weights(net, &made_up).unwrap();
    heads(net, &made_up).unwrap();
    made_up.tensors.into_inner()
}

/// Tensors made by [`RandomTensors`].
struct Stored<'a>(&'a BTreeMap<String, ImportedTensor>);

impl Tensors for Stored<'_> {
    fn tensor(&self, name: &str, _: &[usize]) -> Result<Vec<f32>, LpipsError> {
        Ok(self.0[name].values.clone())
    }
}

fn image(width: u32, height: u32, seed: u64) -> Image {
    let mut rng = Rng::new(seed, 1);
    let data = (0..3 * width * height).map(|_| rng.uniform()).collect();
    Image::new(width, height, 3, data)
}

/// `[channel][row][column]`.
type Planes = Vec<Vec<Vec<f64>>>;

fn convolved(planes: &Planes, weight: &ImportedTensor, bias: &[f32], stride: usize, padding: usize) -> Planes {
    let [outputs, inputs, side] = [weight.shape[0], weight.shape[1], weight.shape[2]];
    let (height, width) = (planes[0].len(), planes[0][0].len());
    let size = |n: usize| (n + 2 * padding - side) / stride + 1;
    let at = |i: usize, y: usize, x: usize| match (y.checked_sub(padding), x.checked_sub(padding)) {
        (Some(y), Some(x)) if y < height && x < width => planes[i][y][x],
        _ => 0.0,
    };
    let value = |o: usize, oy: usize, ox: usize| {
        let mut sum = f64::from(bias[o]);
        for i in 0..inputs {
            for ky in 0..side {
                for kx in 0..side {
                    let w = weight.values[((o * inputs + i) * side + ky) * side + kx];
                    sum += f64::from(w) * at(i, oy * stride + ky, ox * stride + kx);
                }
            }
        }
        sum.max(0.0)
    };
    let row = |o: usize, y: usize| (0..size(width)).map(|x| value(o, y, x)).collect();
    let plane = |o: usize| (0..size(height)).map(|y| row(o, y)).collect();
    (0..outputs).map(plane).collect()
}

fn halved(planes: &Planes) -> Planes {
    let (height, width) = (planes[0].len() / 2, planes[0][0].len() / 2);
    let largest = |p: &[Vec<f64>], y: usize, x: usize| {
        let rows = p[2 * y..2 * y + 2].iter().flat_map(|row| &row[2 * x..2 * x + 2]);
        rows.fold(f64::MIN, |m, v| m.max(*v))
    };
    let row = |p: &[Vec<f64>], y: usize| (0..width).map(|x| largest(p, y, x)).collect();
    planes
        .iter()
        .map(|p| (0..height).map(|y| row(p, y)).collect())
        .collect()
}

/// The features of VGG16, configuration D of its paper, after the last ReLU of each of five groups.
fn vgg(tensors: &BTreeMap<String, ImportedTensor>, image: &Image) -> Vec<Planes> {
    let (mean, deviation) = ([-0.030, -0.088, -0.188], [0.458, 0.448, 0.450]);
    let (width, height) = (image.width as usize, image.height as usize);
    let color = |c: usize, y: usize, x: usize| {
        let value = f64::from(image.data[(y * width + x) * 3 + c]);
        (2.0 * value - 1.0 - mean[c]) / deviation[c]
    };
    let row = |c: usize, y: usize| (0..width).map(|x| color(c, y, x)).collect();
    let mut planes: Planes = (0..3).map(|c| (0..height).map(|y| row(c, y)).collect()).collect();
    let (mut taps, mut number) = (Vec::new(), 0);
    for (group, convolutions) in [2, 2, 3, 3, 3].into_iter().enumerate() {
        if group > 0 {
            planes = halved(&planes);
            number += 1; // The pooling.
        }
        for _ in 0..convolutions {
            let [weight, bias] = ["weight", "bias"].map(|part| &tensors[&format!("features.{number}.{part}")]);
            planes = convolved(&planes, weight, &bias.values, 1, 1);
            number += 2; // The convolution and its ReLU.
        }
        taps.push(planes.clone());
    }
    taps
}

/// Equation 1 of the LPIPS paper.
fn distance(tensors: &BTreeMap<String, ImportedTensor>, a: &[Planes], b: &[Planes]) -> f64 {
    let mut total = 0.0;
    for (tap, (a, b)) in a.iter().zip(b).enumerate() {
        let head = &tensors[&format!("lin{tap}.model.1.weight")].values;
        let (height, width) = (a[0].len(), a[0][0].len());
        for y in 0..height {
            for x in 0..width {
                let norm = |p: &Planes| p.iter().map(|p| p[y][x] * p[y][x]).sum::<f64>().sqrt() + 1e-10;
                let (na, nb) = (norm(a), norm(b));
                let channel = |c: usize| f64::from(head[c]) * (a[c][y][x] / na - b[c][y][x] / nb).powi(2);
                total += (0..head.len()).map(channel).sum::<f64>() / (height * width) as f64;
            }
        }
    }
    total
}

#[test]
fn vgg_matches_plain_loops() {
    let tensors = random_tensors(LpipsNet::Vgg);
    let (net, bytes) = to_weights_file(&tensors).unwrap();
    assert_eq!((net, tensors.len()), (LpipsNet::Vgg, 2 * 13 + 5));
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(net.file_name());
    std::fs::write(&path, bytes).unwrap();
    let lpips = Lpips::load(&path).unwrap();
    assert_eq!(lpips.net(), LpipsNet::Vgg);
    // The smallest side for four poolings, and sides that they do not divide.
    for (width, height) in [(16, 16), (23, 17)] {
        let (a, b) = (image(width, height, 1), image(width, height, 2));
        let want = distance(&tensors, &vgg(&tensors, &a), &vgg(&tensors, &b));
        let got = lpips.distance(&a, &b).unwrap();
        // Thirteen layers in single precision.
        assert!((got / want - 1.0).abs() < 1e-4, "{got}, expected {want}");
    }
    let small = lpips.distance(&image(40, 15, 1), &image(40, 15, 2)).unwrap_err();
    assert!(small.to_string().contains("at least 16 pixels"), "{small}");
}

#[test]
fn alex_and_vgg_gradients_match_finite_differences() {
    for (net, width, height) in [(LpipsNet::Alex, 37, 31), (LpipsNet::Vgg, 17, 16)] {
        let tensors = random_tensors(net);
        let network = Network::<f64>::from_weights(net, &Stored(&tensors)).unwrap();
        let wide = |image: &Image| {
            let map = map_of(image);
            Map {
                height: map.height,
                width: map.width,
                channels: 3,
                data: map.data.iter().map(|v| f64::from(*v)).collect(),
            }
        };
        let (a, b) = (wide(&image(width, height, 1)), wide(&image(width, height, 2)));
        let (value, v) = network.distance_and_gradient(a.clone(), b.clone());
        assert!((value - network.distance(a.clone(), b.clone())).abs() < 1e-12);
        let moved = |data: &[f64]| {
            let data = data.to_vec();
            network.distance(Map { data, ..a }, b.clone())
        };
        // Between kinks the distance is smooth; a step of 1e-7 crosses almost none.
        check_directional(&a.data, &v.data, moved, 1e-7, 1e-5);
    }
}

#[test]
fn importing_incomplete_networks_fails() {
    let refused = |tensors: &BTreeMap<String, ImportedTensor>, part: &str| {
        let line = to_weights_file(tensors).unwrap_err().to_string();
        assert!(line.contains(part) && !line.contains('\n'), "{line}");
    };
    refused(&BTreeMap::new(), "no features of SqueezeNet");
    let whole = random_tensors(LpipsNet::Squeeze);
    let mut tensors = whole.clone();
    tensors.remove("lin6.model.1.weight");
    refused(&tensors, "lin6.model.1.weight is missing");
    let mut tensors = whole.clone();
    tensors.get_mut("features.0.bias").unwrap().shape = vec![8, 8];
    refused(&tensors, "features.0.bias is [8, 8], expected [64]");
    let mut tensors = whole.clone();
    tensors.get_mut("features.0.bias").unwrap().values[3] = f32::INFINITY;
    refused(&tensors, "features.0.bias has values that are not finite");
    // The classifier is skipped.
    let mut more = whole.clone();
    let extra = ImportedTensor {
        shape: vec![1],
        values: vec![1.0],
    };
    more.insert("classifier.1.weight".to_owned(), extra);
    assert_eq!(to_weights_file(&more).unwrap(), to_weights_file(&whole).unwrap());
}
