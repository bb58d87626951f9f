//! Maps features and matches from a file and writes the poses, for comparison with other programs:
//! `map_matches MATCHES [POSES]`. All numbers are little-endian: u32 photographs; each: u32 length and bytes of the name, u32
//! width, u32 height, f64 focal length or 0, u32 keypoints, each f32 x, y, scale, angle; u32 pairs; each: u32 first, second,
//! matches, each u32 keypoint of the first and of the second.

use irradia_sfm::map::{MapOptions, PhotoInfo, Progress, reconstruct};
use irradia_sfm::{Features, Keypoint, PairMatches};
use std::io::Write;
use std::time::Instant;

struct Reader(std::vec::IntoIter<u8>);

impl Reader {
    fn bytes<const N: usize>(&mut self) -> [u8; N] {
        std::array::from_fn(|_| self.0.next().expect("the file is complete"))
    }
    fn u32(&mut self) -> u32 {
        u32::from_le_bytes(self.bytes())
    }
    fn f32(&mut self) -> f32 {
        f32::from_le_bytes(self.bytes())
    }
    fn f64(&mut self) -> f64 {
        f64::from_le_bytes(self.bytes())
    }
}

fn main() {
    let mut arguments = std::env::args().skip(1);
    let path = arguments.next().expect("usage: map_matches MATCHES [POSES]");
    let mut file = Reader(std::fs::read(path).expect("the file is readable").into_iter());
    let (mut photos, mut features, mut pairs) = (Vec::new(), Vec::new(), Vec::new());
    for _ in 0..file.u32() {
        let length = file.u32();
        let name = String::from_utf8((0..length).map(|_| file.bytes::<1>()[0]).collect()).expect("names are UTF-8");
        let (width, height, focal) = (file.u32(), file.u32(), file.f64());
        photos.push(PhotoInfo {
            focal_prior_px: (focal > 0.0).then_some(focal),
            ..PhotoInfo::new(name, width, height)
        });
        let keypoints = (0..file.u32())
            .map(|_| Keypoint {
                x: file.f32(),
                y: file.f32(),
                scale: file.f32(),
                angle: file.f32(),
            })
            .collect();
        features.push(Features {
            keypoints,
            ..Features::default()
        });
    }
    for _ in 0..file.u32() {
        let photos = [file.u32(), file.u32()];
        let matches = (0..file.u32()).map(|_| [file.u32(), file.u32()]).collect();
        pairs.push(PairMatches { photos, matches });
    }
    let mut options = MapOptions::default();
    if let Ok(photos) = std::env::var("FULL_LENS_PHOTOS") {
        options.full_lens_photos = photos.parse().expect("a number");
    }
    let start = Instant::now();
    let verbose = std::env::var_os("VERBOSE").is_some();
    let result = reconstruct(&photos, &features, &pairs, &options, &mut |progress| {
        if verbose || matches!(progress, Progress::Verified { .. }) {
            println!("{:7.3} {progress:?}", start.elapsed().as_secs_f64());
        }
    });
    println!("{:7.3} s", start.elapsed().as_secs_f64());
    for model in &result.models {
        println!(
            "{} of {} photographs, {} points, {} observations, mean error {:.4} px, camera {:?}",
            model.registered(),
            photos.len(),
            model.points.len(),
            model.points.iter().map(|p| p.track.len()).sum::<usize>(),
            model.mean_error(),
            model
                .cameras
                .iter()
                .flatten()
                .next()
                .map(|c| c.parameters.map(|p| (p * 1e4).round() / 1e4)),
        );
    }
    for left in &result.left_out {
        println!("{}: {}", photos[left.photo].name, left.reason);
    }
    if let (Some(path), Some(model)) = (arguments.next(), result.models.first()) {
        let mut out = std::fs::File::create(path).expect("the output is writable");
        for (photo, pose) in photos.iter().zip(&model.poses) {
            let Some(pose) = pose else { continue };
            let rotation = pose.camera_rotation();
            let translation = -(rotation * pose.position);
            let rows = rotation.transpose();
            let row = |r: glam::DVec3, t: f64| format!("{} {} {} {}", r.x, r.y, r.z, t);
            writeln!(
                out,
                "{} {} {} {}",
                photo.name.replace(' ', "_"),
                row(rows.x_axis, translation.x),
                row(rows.y_axis, translation.y),
                row(rows.z_axis, translation.z)
            )
            .expect("the output is writable");
        }
    }
}
