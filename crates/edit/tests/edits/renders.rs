//! Rendering of edited scenes: if the scene and the camera move alike, nothing changes.

use crate::{apply_line, cameras, draft};
use irradia_edit::Draft;
use irradia_scene::Camera;
use irradia_splat::{RenderOptions, Renderer, Splats, ViewParams};

/// Colour, `[3, H, W]`.
fn render(draft: &Draft, camera: &Camera) -> Vec<f32> {
    let mut renderer = Renderer::new();
    let splats = Splats::from_cloud(&draft.visible_cloud());
    renderer.render(&splats, &ViewParams::new(camera), &RenderOptions::default());
    renderer.color().to_vec()
}

fn psnr(a: &[f32], b: &[f32]) -> f64 {
    let square = |(a, b): (&f32, &f32)| (f64::from(*a) - f64::from(*b)).powi(2);
    let error = a.iter().zip(b).map(square).sum::<f64>() / a.len() as f64;
    -10.0 * error.log10()
}

#[test]
fn a_moved_scene_renders_as_its_moved_cameras_see_it() {
    let before = draft(400, 3);
    for line in [
        "rotate axis=1,2,3 degrees=77",
        "rotate axis=0,1,0 degrees=180 about=1,2,3",
        "move by=3,-2,0.5",
        "scale factor=7 about=1,0,0",
        "scale factor=0.001",
        "upright up=1,1,0.3 ground=0,1,0 axis=z",
        "set-length from=0,0,0 to=0,0,1 length=250",
    ] {
        let mut after = before.clone();
        apply_line(&mut after, line);
        for (old, new) in before.cameras.iter().zip(&after.cameras) {
            let (a, b) = (render(&before, old), render(&after, new));
            assert!(a.iter().any(|v| *v > 0.2));
            // 50 dB is required; rounding alone is far below.
            let psnr = psnr(&a, &b);
            assert!(psnr >= 60.0, "{line}: {psnr:.1} dB");
        }
    }
    // Not everything renders alike.
    let mut turned = before.clone();
    apply_line(&mut turned, "rotate axis=1,2,3 degrees=77");
    assert!(
        psnr(
            &render(&before, &before.cameras[0]),
            &render(&turned, &before.cameras[0])
        ) < 25.0
    );
}

#[test]
fn a_rotated_scene_without_its_harmonics_rotated_would_be_noticed() {
    let before = draft(400, 3);
    let mut after = before.clone();
    apply_line(&mut after, "rotate axis=1,2,3 degrees=77");
    let mut wrong = after.clone();
    wrong.cloud.sh = before.cloud.sh.clone();
    let (a, b) = (render(&before, &before.cameras[0]), render(&wrong, &after.cameras[0]));
    assert!(psnr(&a, &b) < 35.0);
}

#[test]
fn hiding_looks_like_deleting_and_splitting_leaves_the_rest() {
    let before = draft(300, 1);
    let shape = "sphere center=0.3,0,0 radius=0.6";
    let after = |op: &str| {
        let mut after = before.clone();
        apply_line(&mut after, &format!("{op} {shape}"));
        render(&after, &before.cameras[0])
    };
    assert_eq!(after("hide"), after("delete"));
    assert_eq!(after("split name=part"), after("delete"));
    assert_ne!(after("delete"), render(&before, &before.cameras[0]));
}

#[test]
fn exposure_multiplies_the_picture_and_grey_is_grey() {
    let mut before = draft(300, 2);
    // Clamping at 0 comes after the map, so that dark colours would differ.
    before.cloud.sh.iter_mut().for_each(|value| *value *= 0.1);
    let camera = &cameras()[2];
    let mut after = before.clone();
    apply_line(&mut after, "recolor exposure=2.2");
    let (a, b) = (render(&before, camera), render(&after, camera));
    assert!(a.iter().zip(&b).all(|(a, b)| (2.0 * a - b).abs() < 1e-4));
    let mut grey = before.clone();
    apply_line(&mut grey, "recolor saturation=0");
    let picture = render(&grey, camera);
    let n = picture.len() / 3;
    assert!(
        (0..n).all(|i| (picture[i] - picture[n + i]).abs() < 1e-5 && (picture[i] - picture[2 * n + i]).abs() < 1e-5)
    );
}

#[test]
fn a_smaller_opacity_shows_more_of_the_background() {
    let before = draft(300, 0);
    let mut after = before.clone();
    apply_line(&mut after, "opacity factor=0.2");
    let sum = |draft: &Draft| {
        let mut renderer = Renderer::new();
        let view = ViewParams::new(&before.cameras[0]);
        renderer.render(&Splats::from_cloud(&draft.cloud), &view, &RenderOptions::default());
        renderer.alpha().iter().sum::<f32>()
    };
    assert!(sum(&after) < 0.6 * sum(&before));
}
