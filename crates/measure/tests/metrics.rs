//! Metrics against golden values (an independent implementation) and LPIPS against its published check values.

mod tensors;

use irradia_measure::{Lpips, LpipsError, LpipsNet, Networks, evaluate, psnr, ssim};
use irradia_scene::Image;
use irradia_testkit::shared;
use safetensors::SafeTensors;
use safetensors::tensor::TensorView;
use std::fs;
use tensors::{read_image, tensor_image};

const WEIGHTS: &str = "data/lpips/lpips_squeeze.safetensors";

#[test]
fn psnr_and_ssim_match_golden_values() {
    let (Some(values), Some(tensors)) = (
        shared("golden/metrics/metrics.json"),
        shared("golden/metrics/metrics.safetensors"),
    ) else {
        return;
    };
    let values: serde_json::Value = serde_json::from_slice(&fs::read(values).unwrap()).unwrap();
    let bytes = fs::read(tensors).unwrap();
    let tensors = SafeTensors::deserialize(&bytes).unwrap();
    for (case, expected) in values.as_object().unwrap() {
        let render = tensor_image(&tensors, &format!("{case}/img1"));
        let truth = tensor_image(&tensors, &format!("{case}/img2"));
        // Both sides compute in double precision from the same floats: only the order of sums differs.
        for (name, got) in [
            ("psnr", psnr(&render, &truth)),
            ("ssim_inria_same", ssim(&render, &truth)),
        ] {
            let want = expected[name].as_f64().unwrap();
            assert!((got - want).abs() < 1e-9, "{case} {name}: {got}, expected {want}");
        }
    }
}

#[test]
fn lpips_matches_the_published_check_values() {
    for (which, far, near) in [(LpipsNet::Squeeze, 0.7110, 0.1479), (LpipsNet::Alex, 0.7219, 0.1376)] {
        let Some(weights) = shared(&format!("data/lpips/{}", which.file_name())) else {
            return;
        };
        let net = Lpips::load(weights).unwrap();
        assert_eq!(net.net(), which);
        let [reference, p0, p1] = ["ref", "p0", "p1"].map(|name| {
            let path = shared(&format!("data/lpips/ex_{name}.png")).unwrap();
            read_image(path)
        });
        // The published values have four digits.
        for (other, want) in [(&p0, far), (&p1, near)] {
            let got = net.distance(&reference, other).unwrap();
            println!("LPIPS {which} {got:.6}, published {want}");
            assert!((got - want).abs() < 6e-5, "{which}: {got}, expected {want}");
        }
        assert_eq!(net.distance(&p0, &p0).unwrap(), 0.0);
        let back = net.distance(&p0, &reference).unwrap();
        assert!((back - far).abs() < 6e-5, "a distance is symmetric: {back}");
    }
}

#[test]
fn lpips_rejects_images_below_the_minimum_size() {
    let Some(weights) = shared(WEIGHTS) else { return };
    let net = Lpips::load(weights).unwrap();
    let side = net.net().min_side();
    for (w, h) in [(side, side), (side, 64), (18, 19), (31, 33)] {
        let mut render = Image::zeros(w, h, 3);
        render.data[0] = 1.0;
        let distance = net.distance(&render, &Image::zeros(w, h, 3)).unwrap();
        assert!(distance > 0.0 && distance < 2.0, "{w}x{h}: {distance}");
    }
    let small = Image::zeros(100, side - 1, 3);
    let error = net.distance(&small, &small).unwrap_err().to_string();
    assert_eq!(
        error,
        "an image of 100x16 is too small for LPIPS; use sides of at least 17 pixels"
    );
    assert_eq!(
        evaluate(
            &small,
            &small,
            None,
            Networks {
                first: Some(&net),
                unseen: None
            }
        )
        .lpips,
        None
    );
}

#[test]
fn evaluating_a_real_pair_matches_golden_values() {
    let (Some(render), Some(truth), Some(weights)) = (
        shared("golden/metrics/real_render.png"),
        shared("golden/metrics/real_gt.png"),
        shared(WEIGHTS),
    ) else {
        return;
    };
    let (render, truth) = (read_image(render), read_image(truth));
    let net = Lpips::load(weights).unwrap();
    let values = evaluate(
        &render,
        &truth,
        None,
        Networks {
            first: Some(&net),
            unseen: None,
        },
    );
    println!("{values:?}");
    // real_fox_pair of metrics.json was computed from these files.
    assert!((values.psnr - 24.646_030).abs() < 1e-3, "{values:?}");
    assert!((values.ssim - 0.753_807_5).abs() < 1e-4, "{values:?}");
    assert!(values.lpips.is_some_and(|v| (0.05..0.5).contains(&v)), "{values:?}");

    // Where the mask is 0 the render has no effect.
    let mut mask = vec![255u8; render.width as usize * render.height as usize];
    let mut poisoned = render.clone();
    for i in 0..mask.len() / 2 {
        mask[i] = 0;
        poisoned.data[3 * i..3 * i + 3].fill(0.9);
    }
    let masked = evaluate(
        &render,
        &truth,
        Some(&mask),
        Networks {
            first: Some(&net),
            unseen: None,
        },
    );
    assert_eq!(
        evaluate(
            &poisoned,
            &truth,
            Some(&mask),
            Networks {
                first: Some(&net),
                unseen: None
            }
        ),
        masked
    );
    // The upper half now equals the truth.
    assert!(masked.lpips < values.lpips.map(|v| 0.7 * v), "{masked:?}");
}

#[test]
fn broken_weights_are_rejected_in_one_line() {
    let folder = tempfile::tempdir().unwrap();
    let refused = |bytes: &[u8], part: &str| {
        let path = folder.path().join("broken.safetensors");
        fs::write(&path, bytes).unwrap();
        let error = Lpips::load(&path).err().expect("must be rejected");
        let line = error.to_string();
        assert!(matches!(error, LpipsError::Weights { .. }), "{line}");
        assert!(
            line.contains("broken.safetensors") && line.contains(part) && !line.contains('\n'),
            "{line}"
        );
    };
    refused(b"", "not a complete safetensors file");
    refused(b"not a file of tensors at all", "not a complete safetensors file");
    refused(&u64::MAX.to_le_bytes(), "not a complete safetensors file");
    let bias = [0u8; 256];
    let whole = |tensors: &[(&str, Vec<usize>, &[u8])]| {
        let view = |shape: &Vec<usize>, data| TensorView::new(safetensors::Dtype::F32, shape.clone(), data).unwrap();
        let views = tensors.iter().map(|(name, shape, data)| (*name, view(shape, data)));
        safetensors::serialize(views, None).unwrap()
    };
    refused(&whole(&[("something", vec![64], &bias)]), "no features of SqueezeNet");
    let mark = ("features.3.squeeze.weight", vec![64], &bias[..]);
    refused(&whole(std::slice::from_ref(&mark)), "features.0.weight is missing");
    refused(
        &whole(&[mark.clone(), ("features.0.weight", vec![64], &bias)]),
        "[64], expected F32 [64, 3, 3, 3]",
    );
    let nan = f32::NAN.to_le_bytes().repeat(64 * 27);
    let poison = ("features.0.weight", vec![64, 3, 3, 3], &nan[..]);
    refused(&whole(&[mark, poison]), "not finite");
    let missing = Lpips::load(folder.path().join("absent"))
        .err()
        .expect("absent")
        .to_string();
    assert!(missing.starts_with("cannot read the LPIPS weights"), "{missing}");

    let Some(weights) = shared(WEIGHTS) else { return };
    let bytes = fs::read(weights).unwrap();
    refused(&bytes[..bytes.len() / 2], "not a complete safetensors file");
}
