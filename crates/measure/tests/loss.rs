//! The public API of the loss: golden gradients, 8-bit truths, padded planes.

mod tensors;

use irradia_measure::{LossWeights, PhotometricLoss, Target, Truth};
use irradia_scene::{Image, Rng};
use irradia_testkit::shared;
use safetensors::SafeTensors;
use tensors::{tensor_f64, tensor_image};

/// `[3, stride]` of an `[H, W, 3]` image, with NaN in the padding, which must not be read.
fn planar(image: &Image, stride: usize) -> Vec<f32> {
    let mut planes = vec![f32::NAN; 3 * stride];
    for (i, value) in image.data.iter().enumerate() {
        planes[i % 3 * stride + i / 3] = *value;
    }
    planes
}

#[test]
fn ssim_and_its_gradient_match_golden_values() {
    let Some(path) = shared("golden/metrics/metrics.safetensors") else {
        return;
    };
    let bytes = std::fs::read(path).unwrap();
    let tensors = SafeTensors::deserialize(&bytes).unwrap();
    for case in ["rand_noise_48x37", "rand_perturbed_80x64", "smooth_shift_120x90"] {
        let render = tensor_image(&tensors, &format!("{case}/img1"));
        let truth = tensor_image(&tensors, &format!("{case}/img2"));
        let map = tensor_f64(&tensors, &format!("{case}/map_inria_same"));
        let want = tensor_f64(&tensors, &format!("{case}/grad_inria_same"));
        let pixels = render.data.len() / 3;
        let stride = pixels + 5;
        let mut v_render = vec![0.0; 3 * stride];
        let truth_planes = planar(&truth, pixels);
        let target = Target {
            width: render.width as usize,
            height: render.height as usize,
            truth: Truth::Planar(&truth_planes),
            mask: None,
        };
        let values = PhotometricLoss::new().evaluate(
            &planar(&render, stride),
            &target,
            &LossWeights::photometric(1.0),
            &mut v_render,
        );
        let mean = map.iter().sum::<f64>() / map.len() as f64;
        let ssim = values.ssim.unwrap();
        // In flat windows single precision cancels to 1e-4 of a similarity; the golden implementation in floats is 4e-6 off.
        assert!((ssim - mean).abs() < 1e-5, "{case}: {ssim}, expected {mean}");
        let largest = want.iter().fold(0.0f64, |m, v| m.max(v.abs()));
        let mut worst = 0.0f64;
        for (i, want) in want.iter().enumerate() {
            // The loss is 1 - SSIM: its gradient has the other sign.
            worst = worst.max((f64::from(v_render[i % 3 * stride + i / 3]) + want).abs() / largest);
        }
        println!(
            "{case}: SSIM off by {:.1e}, gradient by {worst:.1e} of its largest",
            (ssim - mean).abs()
        );
        assert!(worst < 1e-4, "{case}: {worst}");
        assert!(
            (0..3).all(|c| v_render[c * stride + pixels..][..5] == [0.0; 5]),
            "padding is not written"
        );
    }
}

#[test]
fn eight_bit_and_planar_truths_agree() {
    let (width, height) = (37, 21);
    let mut rng = Rng::new(3, 0);
    let bytes: Vec<u8> = (0..3 * width * height).map(|_| rng.below(256) as u8).collect();
    let floats = bytes.iter().map(|b| f32::from(*b) / 255.0).collect();
    let planes = planar(&Image::new(width as u32, height as u32, 3, floats), width * height);
    let render: Vec<f32> = (0..3 * width * height).map(|_| rng.uniform()).collect();
    let run = |truth: Truth| {
        let mut v_render = vec![0.0; render.len()];
        let target = Target {
            width,
            height,
            truth,
            mask: None,
        };
        let values = PhotometricLoss::new().evaluate(&render, &target, &LossWeights::photometric(0.2), &mut v_render);
        (values, v_render)
    };
    assert_eq!(run(Truth::Rgb8(&bytes)), run(Truth::Planar(&planes)));
}

#[test]
fn an_empty_image_has_zero_loss() {
    let target = Target {
        width: 0,
        height: 7,
        truth: Truth::Rgb8(&[]),
        mask: None,
    };
    let values = PhotometricLoss::new().evaluate(&[], &target, &LossWeights::photometric(0.2), &mut []);
    assert_eq!((values.total, values.ssim), (0.0, Some(1.0)));
}
