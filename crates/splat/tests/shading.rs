//! Colours added to the splats' own.

use irradia_scene::{Camera, Intrinsics, Pose, Rng, sh};
use irradia_splat::{OutputGradient, RenderOptions, Renderer, SplatGradients, Splats, ViewParams};

/// Splats in front of a camera at the origin, some of them outside its view, some with colours below 0.
fn scene() -> (Splats, ViewParams) {
    let mut rng = Rng::new(7, 0);
    let mut splats = Splats::zeros(60, 1);
    for i in 0..60 {
        splats.quats.set(0, i, 1.0);
        for c in 0..3 {
            let spread = if c == 2 {
                rng.range(2.0, 4.0)
            } else {
                rng.range(-2.0, 2.0)
            };
            splats.means.set(c, i, spread);
            splats.log_scales.set(c, i, rng.range(-2.5, -1.0));
        }
        for k in 0..12 {
            splats.sh.set(k, i, rng.range(-1.5, 1.5));
        }
    }
    let pose = Pose {
        position: glam::Vec3::ZERO,
        rotation: glam::Quat::IDENTITY,
    };
    let camera = Camera::new(pose, Intrinsics::from_fov_x(48, 40, 0.8));
    (splats, ViewParams::new(&camera))
}

#[test]
fn an_added_colour_equals_a_change_of_the_dc_coefficient_forward_and_backward() {
    let (splats, view) = scene();
    let options = RenderOptions::default();
    let added = |i: u32| [0, 1, 2].map(|c| 0.2 * ((i + c) as f32).sin());
    let mut shaded = Renderer::new();
    shaded.project(&splats, &view, &options);
    let colors: Vec<[f32; 3]> = shaded.in_view().iter().map(|i| added(*i)).collect();
    shaded.add_colors(&colors);
    shaded.composite();
    assert!((1..60).contains(&shaded.in_view().len()), "{}", shaded.in_view().len());

    let mut moved = splats.clone();
    for i in 0..60 {
        for c in 0..3 {
            moved
                .sh
                .set(c, i, moved.sh.get(c, i) + added(i as u32)[c] / sh::C0 as f32);
        }
    }
    let mut plain = Renderer::new();
    plain.render(&moved, &view, &options);
    let most = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(most(shaded.color(), plain.color()) < 1e-5);
    let mut without = Renderer::new();
    without.render(&splats, &view, &options);
    assert!(most(shaded.color(), without.color()) > 0.05);

    let v_color: Vec<f32> = (0..shaded.color().len()).map(|i| (i as f32).cos()).collect();
    let [mut a, mut b] = [SplatGradients::default(), SplatGradients::default()];
    shaded.backward(&splats, &OutputGradient::of_color(&v_color), &mut a);
    plain.backward(&moved, &OutputGradient::of_color(&v_color), &mut b);
    assert_eq!(a.active, b.active);
    for i in shaded
        .in_view()
        .iter()
        .map(|i| *i as usize)
        .filter(|i| a.active[*i] > 0.0)
    {
        for c in 0..3 {
            let [a, b] = [&a, &b].map(|g| g.splats.sh.get(c, i));
            assert!((a - b).abs() < 1e-3 * (1.0 + b.abs()), "splat {i}: {a} and {b}");
        }
    }
}
