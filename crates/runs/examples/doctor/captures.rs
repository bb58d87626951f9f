//! Clean captures, and captures with planted faults (injuries).

use glam::{Quat, Vec2, Vec3};
use irradia_runs::formats::{read_image, write_png};
use irradia_runs::scene::{Camera, Intrinsics, Pose, Rng};
use irradia_runs::synth::{Cluster, Material, Object, SceneName, Shape, SynthScene, Texture};
use rayon::prelude::*;
use std::error::Error;
use std::fs;
use std::path::{Path, PathBuf};

/// Names of real captures, and the folders of their photographs.
const REAL_CAPTURES: [(&str, &str); 7] = [
    ("fox", "fox/images"),
    ("maryRose", "maryRose/images_4"),
    ("cup", "cup/images"),
    ("lund_door", "lund_door/images"),
    ("fern", "fern/images_8"),
    ("street", "lund_street_unposed/images"),
    ("can", "can/images"),
];
/// Size of ray-traced photographs, px, and their field of view, radians.
const PHOTO_SIZE: [u32; 2] = [480, 360];
const FOV_RADIANS: f32 = 0.9;
/// Number of photographs around a ray-traced scene.
const RING_PHOTOS: usize = 48;

/// An RGB image.
#[derive(Clone)]
pub struct Picture {
    width: usize,
    height: usize,
    /// `[H, W, 3]`
    rgb: Vec<u8>,
}

/// What a capture shows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Source {
    /// Photographs: name and folder in `../shared/data`.
    Real(&'static str, &'static str),
    /// All around a ray-traced scene.
    Ring(SceneName, u64),
    /// Around one of two groups that look alike, then over to the other and around it.
    Twins(u64),
    /// Rotating on the spot in a ray-traced room.
    Spot(u64),
}

/// A capture with at most one injury.
#[derive(Clone, Copy, Debug)]
pub struct Capture {
    source: Source,
    /// `clean`, or what was done to it.
    pub injury: &'static str,
}

/// What the doctor should say.
pub enum Expected {
    /// Nothing, for this many photographs.
    Nothing {
        /// Their number.
        photographs: usize,
    },
    /// A kind of finding for exactly these photographs.
    Photographs {
        /// The kind.
        kind: &'static str,
        /// Their names.
        names: Vec<String>,
    },
    /// Any of these kinds of finding.
    Capture {
        /// The kinds.
        kinds: &'static [&'static str],
    },
}

/// All captures, clean ones first.
pub fn all() -> Vec<Capture> {
    let real: Vec<Source> = REAL_CAPTURES
        .iter()
        .map(|(name, path)| Source::Real(name, path))
        .collect();
    let rings = [
        Source::Ring(SceneName::Demo, 1),
        Source::Ring(SceneName::Thin, 2),
        Source::Ring(SceneName::Outdoor, 3),
    ];
    let both = |real_too: &[Source]| [real_too, &rings[..]].concat();
    let of =
        |injury: &'static str, sources: Vec<Source>| sources.into_iter().map(move |source| Capture { source, injury });
    of("clean", both(&real))
        .chain(of("blur", both(&[real[0], real[4], real[5]])))
        .chain(of("exposure", both(&[real[0], real[4], real[5]])))
        .chain(of("zoom", both(&[real[0], real[4]])))
        .chain(of("cut", both(&[real[0], real[4]])))
        .chain(of("gap", rings.to_vec()))
        .chain(of("loop", rings.to_vec()))
        .chain(of("rotation", (1..5).map(Source::Spot).collect()))
        .chain(of("turntable", [&real[1..2], &rings[..]].concat()))
        .chain(of("moving", both(&[real[0], real[4]])))
        .chain(of("twin", (1..4).map(Source::Twins).collect()))
        .collect()
}

impl Capture {
    /// Such as `fox-blur`.
    pub fn name(&self) -> String {
        let source = match self.source {
            Source::Real(name, _) => name.to_owned(),
            Source::Ring(scene, seed) => format!("{scene}{seed}"),
            Source::Twins(seed) => format!("twins{seed}"),
            Source::Spot(seed) => format!("room{seed}"),
        };
        format!("{source}-{}", self.injury)
    }

    /// Whether a finding of `kind` does not count as wrong: it may be a consequence of the injury, or a fault of the real capture.
    pub fn tolerates(&self, kind: &str) -> bool {
        match (self.injury, kind) {
            // Photographs without a pose leave gaps.
            ("blur" | "exposure" | "zoom" | "cut" | "moving", "gap" | "open-loop") => true,
            ("gap", "open-loop") | ("loop", "gap") | ("turntable", "moving" | "contradiction" | "rotation-only") => {
                true
            }
            // If the board has more matches than the scene, the model follows the board and is in fact wrong.
            ("moving" | "zoom", "contradiction") | ("twin", "gap" | "open-loop" | "moving") => true,
            _ => false,
        }
    }

    /// The folder of its photographs: `folder`, into which they are written unless an earlier call did so, or the original folder of a
    /// clean real capture.
    pub fn photographs(&self, folder: &Path) -> Result<(PathBuf, Expected), Box<dyn Error>> {
        if let (Source::Real(_, path), "clean") = (self.source, self.injury) {
            let photographs = fs::read_dir(shared(path))?.count();
            return Ok((shared(path), Expected::Nothing { photographs }));
        }
        Ok((folder.to_owned(), self.write(folder)?))
    }

    fn write(&self, folder: &Path) -> Result<Expected, Box<dyn Error>> {
        let mut pictures = self.source.pictures()?;
        let n = pictures.len();
        let name = |i: usize| format!("{i:03}.png");
        let mut rng = Rng::new(n as u64, 11);
        let tenth: Vec<usize> = (0..n).skip(4).step_by(8).collect();
        let mut kept: Vec<usize> = (0..n).collect();
        let expected = match self.injury {
            "blur" => {
                for (turn, i) in tenth.iter().enumerate() {
                    pictures[*i] = pictures[*i].motion_blurred(turn);
                }
                Expected::Photographs {
                    kind: "blurred",
                    names: tenth.iter().map(|i| name(*i)).collect(),
                }
            }
            "exposure" => {
                for (turn, i) in tenth.iter().enumerate() {
                    pictures[*i].change_exposure(if turn % 2 == 0 { 3.0 } else { -3.0 });
                }
                Expected::Photographs {
                    kind: "exposure",
                    names: tenth.iter().map(|i| name(*i)).collect(),
                }
            }
            "zoom" => {
                let zoomed: Vec<usize> = (n / 2..n).collect();
                for i in zoomed {
                    pictures[i] = pictures[i].zoomed(1.6);
                }
                Expected::Capture { kinds: &["zoom"] }
            }
            "cut" => {
                pictures = pictures.iter().map(|picture| picture.cropped(0.75)).collect();
                Expected::Capture { kinds: &["cut"] }
            }
            "gap" => {
                kept.retain(|i| !(7..7 + 60 * RING_PHOTOS / 360).contains(i));
                Expected::Capture { kinds: &["gap"] }
            }
            "loop" => {
                kept.retain(|i| *i < RING_PHOTOS - 4);
                Expected::Capture { kinds: &["open-loop"] }
            }
            "rotation" => Expected::Capture {
                kinds: &["rotation-only"],
            },
            "turntable" => {
                let behind = Picture::noise(pictures[0].width, pictures[0].height, 99);
                for (picture, background) in pictures.iter_mut().zip(self.source.backgrounds()?) {
                    picture.replace_background(&behind, &background);
                }
                Expected::Capture {
                    kinds: &["stands-still"],
                }
            }
            "moving" => {
                for picture in &mut pictures {
                    if rng.uniform() < 0.7 {
                        picture.add_person(&mut rng);
                    }
                }
                Expected::Capture { kinds: &["moving"] }
            }
            "twin" => Expected::Capture {
                kinds: &["contradiction", "separate-parts", "missing-matches"],
            },
            _ => Expected::Nothing { photographs: n },
        };
        if !folder.exists() {
            for i in kept {
                let picture = &pictures[i];
                write_png(
                    &folder.join(name(i)),
                    picture.width as u32,
                    picture.height as u32,
                    3,
                    &picture.rgb,
                )?;
            }
        }
        Ok(expected)
    }
}

impl Source {
    fn pictures(self) -> Result<Vec<Picture>, Box<dyn Error>> {
        if let Source::Real(_, path) = self {
            let mut files: Vec<PathBuf> = fs::read_dir(shared(path))?
                .map(|entry| Ok(entry?.path()))
                .collect::<Result<_, std::io::Error>>()?;
            files.retain(|file| {
                file.extension()
                    .is_some_and(|e| ["jpg", "JPG", "png"].iter().any(|known| e == *known))
            });
            files.sort();
            let read = |file: &PathBuf| -> Result<Picture, Box<dyn Error + Send + Sync>> { Ok(Picture::read(file)?) };
            return Ok(files
                .par_iter()
                .map(read)
                .collect::<Result<Vec<Picture>, _>>()
                .map_err(|error| error.to_string())?);
        }
        let (scene, cameras) = self.scene();
        Ok(cameras
            .iter()
            .enumerate()
            .map(|(i, camera)| render_picture(&scene, camera, i))
            .collect())
    }

    fn scene(self) -> (SynthScene, Vec<Camera>) {
        let camera = |pose: Pose| Camera::new(pose, Intrinsics::from_fov_x(PHOTO_SIZE[0], PHOTO_SIZE[1], FOV_RADIANS));
        match self {
            Source::Ring(name, seed) => {
                let scene = name.build(seed).0;
                let around = (0..RING_PHOTOS).map(|i| {
                    let azimuth = std::f32::consts::TAU * i as f32 / RING_PHOTOS as f32;
                    let away = Vec3::new(azimuth.cos(), azimuth.sin(), 0.45 + 0.1 * (3.0 * azimuth).sin());
                    camera(Pose::look_at(4.0 * away, Vec3::Z * 0.3, Vec3::Z))
                });
                (scene, around.collect())
            }
            Source::Spot(seed) => {
                let scene = SceneName::Room.build(seed).0;
                let turned = (0..20).map(|i| {
                    let azimuth = std::f32::consts::TAU * i as f32 / 20.0;
                    let eye = Vec3::new(0.3, -0.2, 1.5);
                    let forward = Vec3::new(azimuth.cos(), azimuth.sin(), -0.15);
                    camera(Pose::look_at(eye, eye + forward, Vec3::Z))
                });
                (scene, turned.collect())
            }
            Source::Twins(seed) => twins(seed),
            Source::Real(..) => unreachable!("read, not traced"),
        }
    }

    /// The background pixels of each image.
    fn backgrounds(self) -> Result<Vec<Vec<bool>>, Box<dyn Error>> {
        if let Source::Real(..) = self {
            let is_white = |picture: Picture| {
                picture
                    .rgb
                    .chunks_exact(3)
                    .map(|p| p.iter().all(|v| *v > 235))
                    .collect()
            };
            return Ok(self.pictures()?.into_iter().map(is_white).collect());
        }
        let (scene, cameras) = self.scene();
        let depth = |camera: &Camera| scene.trace(camera, 1, 0).depth.data;
        let is_far = |camera| {
            depth(camera)
                .into_iter()
                .map(|depth| depth > 6.0 || depth == 0.0)
                .collect()
        };
        Ok(cameras.iter().map(is_far).collect())
    }
}

fn shared(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../../../shared/data")
        .join(path)
}

fn render_picture(scene: &SynthScene, camera: &Camera, seed: usize) -> Picture {
    let frame = scene.trace(camera, 2, seed as u64);
    Picture {
        width: PHOTO_SIZE[0] as usize,
        height: PHOTO_SIZE[1] as usize,
        rgb: frame.color.to_u8(),
    }
}

/// Two equal groups of patterned blocks in a park, the second one rotated, with a path of posts between them.
fn twins(seed: u64) -> (SynthScene, Vec<Camera>) {
    let mut rng = Rng::new(seed, 21);
    let block = |center: Vec3, half: Vec3, turn: f32, rng: &mut Rng| Object {
        shape: Shape::Block {
            center,
            half,
            world_from_block: Quat::from_rotation_z(turn),
        },
        material: Material {
            texture: Texture::Patches {
                colors: [0; 2].map(|_| Vec3::new(rng.uniform(), rng.uniform(), rng.uniform())),
                size: rng.range(0.1, 0.3),
            },
            coat: 0.0,
            metal: false,
            roughness: 1.0,
        },
    };
    let second = Vec3::new(14.0, 0.0, 0.0);
    let twist = rng.range(1.0, 2.6);
    let (mut groups, mut posts) = ([Vec::new(), Vec::new()], Vec::new());
    for _ in 0..16 {
        let place = Vec3::new(rng.range(-1.6, 1.6), rng.range(-1.6, 1.6), 0.0);
        let half = Vec3::new(rng.range(0.15, 0.5), rng.range(0.15, 0.5), rng.range(0.15, 0.9));
        let turn = rng.range(0.0, 3.0);
        let mut first = block(place + Vec3::Z * half.z, half, turn, &mut rng);
        groups[0].push(first);
        let moved = second + Quat::from_rotation_z(twist) * place;
        first.shape = Shape::Block {
            center: moved + Vec3::Z * half.z,
            half,
            world_from_block: Quat::from_rotation_z(turn + twist),
        };
        groups[1].push(first);
    }
    for i in 0..24 {
        let half = Vec3::new(rng.range(0.1, 0.3), rng.range(0.1, 0.3), rng.range(0.3, 1.2));
        let place = Vec3::new(3.0 + 0.34 * i as f32, rng.range(1.0, 3.5), half.z);
        posts.push(block(place, half, rng.range(0.0, 3.0), &mut rng));
    }
    let mut scene = SceneName::Outdoor.build(seed).0;
    scene.clusters = groups.into_iter().chain([posts]).map(Cluster::new).collect();
    let camera = |eye: Vec3, target: Vec3| {
        Camera::new(
            Pose::look_at(eye, target, Vec3::Z),
            Intrinsics::from_fov_x(PHOTO_SIZE[0], PHOTO_SIZE[1], FOV_RADIANS),
        )
    };
    let around = |center: Vec3| {
        (0..20).map(move |i| {
            let azimuth = std::f32::consts::TAU * i as f32 / 24.0 - 1.4;
            center + 4.5 * Vec3::new(azimuth.cos(), azimuth.sin(), 0.4)
        })
    };
    let mut cameras: Vec<Camera> = around(Vec3::ZERO).map(|eye| camera(eye, Vec3::Z * 0.4)).collect();
    cameras.extend((0..14).map(|i| {
        let x = 2.0 + 0.75 * i as f32;
        camera(Vec3::new(x, -2.2, 1.6), Vec3::new(x + 0.8, 2.0, 0.5))
    }));
    cameras.extend(around(second).map(|eye| camera(eye, second + Vec3::Z * 0.4)));
    (scene, cameras)
}

impl Picture {
    /// Reads an image at half its size, to save time.
    fn read(file: &Path) -> Result<Self, irradia_runs::formats::FormatError> {
        let divisor = 2;
        let pixels = read_image(file)?;
        let (w, h, channels) = (pixels.width as usize, pixels.height as usize, pixels.channels as usize);
        let (width, height) = (w / divisor, h / divisor);
        let mut rgb = Vec::with_capacity(3 * width * height);
        for i in 0..3 * width * height {
            let (c, x, y) = (i % 3, i / 3 % width * divisor, i / 3 / width * divisor);
            let rows = (y..y + divisor).flat_map(|y| (x..x + divisor).map(move |x| (y * w + x) * channels));
            let sum: usize = rows.map(|at| usize::from(pixels.data[at + c.min(channels - 1)])).sum();
            rgb.push((sum / (divisor * divisor)) as u8);
        }
        Ok(Self { width, height, rgb })
    }

    /// An image of random patches of various sizes.
    fn noise(width: usize, height: usize, seed: u64) -> Self {
        let mut rng = Rng::new(seed, 5);
        let mut rgb = vec![128u8; 3 * width * height];
        for _ in 0..width * height / 60 {
            let side = 3 + (20.0 * rng.uniform() * rng.uniform()) as usize;
            let corner = [width, height].map(|s| rng.below(s as u32) as usize);
            let color = [0; 3].map(|_| rng.below(256) as u8);
            for y in corner[1]..(corner[1] + side).min(height) {
                for x in corner[0]..(corner[0] + side).min(width) {
                    rgb[3 * (y * width + x)..][..3].copy_from_slice(&color);
                }
            }
        }
        Self { width, height, rgb }
    }

    fn pixel(&self, x: usize, y: usize) -> [u8; 3] {
        let at = 3 * (y.min(self.height - 1) * self.width + x.min(self.width - 1));
        [0, 1, 2].map(|c| self.rgb[at + c])
    }

    /// The image blurred over 1.6 % of the longer side: along x, along the diagonal or in all directions, depending on `turn`.
    fn motion_blurred(&self, turn: usize) -> Self {
        let length = (0.016 * self.width.max(self.height) as f64).round().max(3.0) as usize;
        let steps: Vec<(usize, usize)> = match turn % 3 {
            0 => (0..length).map(|i| (i, 0)).collect(),
            1 => (0..length).map(|i| (i * 7 / 10, i * 7 / 10)).collect(),
            _ => (0..length * length / 2)
                .map(|i| (i % length * 7 / 10, i / length))
                .collect(),
        };
        let mut motion_blurred = self.clone();
        for (i, value) in motion_blurred.rgb.iter_mut().enumerate() {
            let (c, x, y) = (i % 3, i / 3 % self.width, i / 3 / self.width);
            let sum: u32 = steps
                .iter()
                .map(|(dx, dy)| u32::from(self.pixel(x + dx, y + dy)[c]))
                .sum();
            *value = (sum / steps.len() as u32) as u8;
        }
        motion_blurred
    }

    /// Exposes the image with `stops` more light.
    fn change_exposure(&mut self, stops: f64) {
        for value in &mut self.rgb {
            let light = (f64::from(*value) / 255.0).powf(2.2) * stops.exp2();
            *value = (255.0 * light.min(1.0).powf(1.0 / 2.2)).round() as u8;
        }
    }

    /// The centre of the image, enlarged by `ratio`.
    fn zoomed(&self, ratio: f64) -> Self {
        let mut zoomed = self.clone();
        let back = |v: usize, side: usize| (v as f64 + 0.5 - 0.5 * side as f64) / ratio + 0.5 * side as f64 - 0.5;
        for (i, value) in zoomed.rgb.iter_mut().enumerate() {
            let (c, x, y) = (
                i % 3,
                back(i / 3 % self.width, self.width),
                back(i / 3 / self.width, self.height),
            );
            let (fx, fy) = (x.fract(), y.fract());
            let at = |dx: usize, dy: usize| f64::from(self.pixel(x as usize + dx, y as usize + dy)[c]);
            let row = |dy: usize| at(0, dy) * (1.0 - fx) + at(1, dy) * fx;
            *value = (row(0) * (1.0 - fy) + row(1) * fy) as u8;
        }
        zoomed
    }

    /// The lower left part of the image, with the fraction `keep` of each side.
    fn cropped(&self, keep: f64) -> Self {
        let [width, height] = [self.width, self.height].map(|side| (keep * side as f64) as usize);
        let above = self.height - height;
        let row = |y: usize| &self.rgb[3 * (above + y) * self.width..][..3 * width];
        Self {
            width,
            height,
            rgb: (0..height).flat_map(row).copied().collect(),
        }
    }

    fn replace_background(&mut self, behind: &Self, background: &[bool]) {
        for (i, is_background) in background.iter().enumerate() {
            if *is_background {
                self.rgb[3 * i..][..3].copy_from_slice(&behind.rgb[3 * i..][..3]);
            }
        }
    }

    /// Covers a random part of the image with a patterned board, the same in each call.
    fn add_person(&mut self, rng: &mut Rng) {
        let side = self.width.min(self.height) / 3;
        let board = Self::noise(side, side, 77);
        let corner = Vec2::new(rng.uniform(), rng.uniform())
            * Vec2::new((self.width - side) as f32, (self.height - side) as f32);
        for y in 0..side {
            for x in 0..side {
                let at = 3 * ((y + corner.y as usize) * self.width + x + corner.x as usize);
                self.rgb[at..at + 3].copy_from_slice(&board.pixel(x, y));
            }
        }
    }
}
