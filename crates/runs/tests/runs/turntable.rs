//! Objects that turn in front of a still background: poses and masks.

use glam::Vec3;
use irradia_runs::formats::{DatasetOptions, read_dataset, read_image, write_png};
use irradia_runs::scene::{Camera, Intrinsics, Pose, Rng};
use irradia_runs::synth::SceneName;
use irradia_runs::{PoseInput, PoseReport, pose};
use std::fs;
use std::path::Path;

const SIZE: [u32; 2] = [320, 240];
/// Photographs around the scene.
const RING_PHOTOS: usize = 32;
/// Distance from the cameras beyond which everything is background.
const MIN_BACKGROUND_DISTANCE: f32 = 6.0;

/// `[photographs][H, W]` whether each pixel is background.
type Backgrounds = Vec<Vec<bool>>;

/// What is behind the turning demo scene.
#[derive(Clone, Copy, PartialEq)]
enum Backdrop {
    /// The scene's own sky: the camera moves around the scene.
    Sky,
    /// A still wall of patches.
    Wall,
    /// Still paper, lit from one side, in changing light.
    Paper,
}

/// Writes photographs all around the demo scene, from heights that vary by `wave`.
fn turntable(photos: &Path, backdrop: Backdrop, wave: f32) -> Backgrounds {
    fs::create_dir_all(photos).unwrap();
    let scene = SceneName::Demo.build(1).0;
    let mut rng = Rng::new(5, 5);
    let patches: Vec<[u8; 3]> = (0..80 * 60)
        .map(|_| [0; 3].map(|_: u8| rng.range(0.0, 256.0) as u8))
        .collect();
    let photograph = |i: usize| {
        let azimuth = std::f32::consts::TAU * i as f32 / RING_PHOTOS as f32;
        let away = Vec3::new(azimuth.cos(), azimuth.sin(), 0.45 + wave * (3.0 * azimuth).sin());
        let pose = Pose::look_at(4.0 * away, Vec3::Z * 0.3, Vec3::Z);
        let frame = scene.trace(
            &Camera::new(
                pose,
                Intrinsics::from_fov_x(SIZE[0], SIZE[1], if backdrop == Backdrop::Paper { 1.3 } else { 0.9 }),
            ),
            2,
            i as u64,
        );
        let far: Vec<bool> = frame
            .depth
            .data
            .iter()
            .map(|depth| *depth > MIN_BACKGROUND_DISTANCE || *depth == 0.0)
            .collect();
        let mut rgb = frame.color.to_u8();
        let light = 1.0 + 0.05 * (2.0 * azimuth).sin();
        for (at, pixel) in rgb.chunks_exact_mut(3).enumerate().filter(|(at, _)| far[*at]) {
            let [x, y] = [at % SIZE[0] as usize, at / SIZE[0] as usize];
            match backdrop {
                Backdrop::Sky => {}
                Backdrop::Wall => pixel.copy_from_slice(&patches[y / 4 * 80 + x / 4]),
                Backdrop::Paper => pixel.fill((light * (225.0 - 0.2 * x as f32)) as u8),
            }
        }
        write_png(&photos.join(format!("{i:02}.png")), SIZE[0], SIZE[1], 3, &rgb).unwrap();
        far
    };
    (0..RING_PHOTOS).map(photograph).collect()
}

/// Poses `photos` in `out`.
fn posed(photos: &Path, out: &Path) -> PoseReport {
    pose(&PoseInput::new(photos, out), &|_| {}).unwrap()
}

/// Angle from each photograph to the next, degrees.
fn steps(out: &Path) -> Vec<f32> {
    let dataset = read_dataset(out, &DatasetOptions::default()).unwrap();
    assert_eq!(dataset.views.len(), RING_PHOTOS);
    let turn = |pair: &[irradia_runs::scene::View]| {
        let [a, b] = [0, 1].map(|i: usize| pair[i].camera.pose.rotation);
        a.angle_between(b).to_degrees()
    };
    dataset.views.windows(2).map(turn).collect()
}

/// The fraction of background pixels that are masked, and the fraction of other pixels that are not.
fn mask_accuracy(masks: &Path, backgrounds: &Backgrounds) -> [f64; 2] {
    let (mut backdrop, mut before) = ([0usize; 2], [0usize; 2]);
    for (i, far) in backgrounds.iter().enumerate() {
        let mask = read_image(&masks.join(format!("{i:02}.png.png"))).unwrap();
        assert_eq!([mask.width, mask.height], SIZE);
        let kept = mask.data.chunks_exact(mask.channels as usize).map(|pixel| pixel[0] > 0);
        for (kept, far) in kept.zip(far) {
            let [count, right] = if *far { &mut backdrop } else { &mut before };
            *count += 1;
            *right += usize::from(kept != *far);
        }
    }
    [backdrop, before].map(|[count, right]| right as f64 / count as f64)
}

#[test]
fn what_turns_is_posed_and_what_stands_still_behind_it_is_masked() {
    let folder = tempfile::tempdir().unwrap();
    let [photos, out] = ["photos", "data"].map(|name| folder.path().join(name));
    let backgrounds = turntable(&photos, Backdrop::Wall, 0.1);
    let report = posed(&photos, &out);
    assert_eq!(report.registered, RING_PHOTOS, "{report:?}");
    let told = |kind: &str| report.findings.iter().find(|finding| finding.kind == kind);
    assert!(told("stands-still").unwrap().sentence.ends_with("it is masked"));
    assert!(
        report
            .warnings
            .iter()
            .any(|warning| warning.contains("masks of your own"))
    );
    // 11.25 degrees around, with a little up and down.
    assert!(
        steps(&out).iter().all(|step| (10.5..12.5).contains(step)),
        "{:?}",
        steps(&out)
    );
    let masks = out.join("masks");
    let [backdrop, before] = mask_accuracy(&masks, &backgrounds);
    assert!(backdrop > 0.93 && before > 0.93, "{backdrop} {before}");

    // A second call gives the same result.
    let model = fs::read(out.join("sparse/0/images.bin")).unwrap();
    let again = posed(&photos, &out);
    assert_eq!(again.warnings, report.warnings);
    assert_eq!(fs::read(out.join("sparse/0/images.bin")).unwrap(), model);
    // When posing in place, the program's own masks do not count as the user's; masks that were edited are put away.
    let edited = masks.join("00.png.png");
    fs::write(&edited, fs::read(masks.join("01.png.png")).unwrap()).unwrap();
    let kept = fs::read(&edited).unwrap();
    let in_place = posed(&out, &out);
    assert_eq!(
        (in_place.registered, in_place.warnings.len()),
        (RING_PHOTOS, report.warnings.len())
    );
    assert_eq!(fs::read_dir(&masks).unwrap().count(), RING_PHOTOS + 1);
    assert_eq!(fs::read(out.join("unused/masks/00.png.2.png")).unwrap(), kept);
    // Photographs with masks of their own keep them.
    let own = folder.path().join("own");
    fs::create_dir(&own).unwrap();
    fs::rename(&photos, own.join("images")).unwrap();
    fs::create_dir(own.join("masks")).unwrap();
    let white = vec![255; (SIZE[0] * SIZE[1]) as usize];
    write_png(&own.join("masks/00.png"), SIZE[0], SIZE[1], 1, &white).unwrap();
    let kept = posed(&own, &folder.path().join("kept"));
    assert!(kept.warnings.is_empty(), "{:?}", kept.warnings);
    assert_eq!(fs::read_dir(folder.path().join("kept/masks")).unwrap().count(), 1);
    // If nothing stands still any more, nothing is masked.
    turntable(&photos, Backdrop::Sky, 0.1);
    assert!(posed(&photos, &out).warnings.is_empty());
    assert!(!masks.exists());
}

#[test]
fn a_plain_backdrop_is_masked_where_the_poses_are_those_of_a_turntable() {
    let folder = tempfile::tempdir().unwrap();
    let [photos, out] = ["photos", "data"].map(|name| folder.path().join(name));
    let masks = out.join("masks");
    let backgrounds = turntable(&photos, Backdrop::Paper, 0.0);
    let report = posed(&photos, &out);
    assert_eq!(report.registered, RING_PHOTOS, "{report:?}");
    let [backdrop, before] = mask_accuracy(&masks, &backgrounds);
    // Backdrop seen through the frames is not connected to the border, and bars are two pixels wide.
    assert!(backdrop > 0.87 && before > 0.87, "{backdrop} {before}");
    let of = |report: &PoseReport| {
        report
            .warnings
            .iter()
            .filter(|w| w.contains("backdrop of a turntable"))
            .count()
    };
    assert_eq!(of(&report), 1, "{:?}", report.warnings);

    // With a handheld camera, no axis stands still.
    turntable(&photos, Backdrop::Paper, 0.3);
    assert_eq!(of(&posed(&photos, &out)), 0);
    assert!(!masks.exists());
}
