//! Levels of detail beside a splat file: a half, a quarter and an eighth of its splats, merged so that they look the same from afar.

use crate::cameras::cameras_beside;
use crate::orbit::orbit;
use crate::{RunError, psnr_8_bits, scene_path};
use irradia_formats::{SplatFormat, WriteOptions, read_splats, splat_file_size, write_splats_with};
use irradia_scene::{Camera, GaussianCloud, resize_area};
use irradia_splat::levels::merged;
use irradia_splat::{RenderOptions, Renderer, Splats};
use irradia_train::model::Model;
use std::fs;
use std::path::{Path, PathBuf};

/// Number of levels beside a scene; each has half as many splats as the one before.
pub const LEVELS: u32 = 3;
/// Maximum number of views in which levels are compared.
const MAX_COMPARED_VIEWS: u32 = 12;
/// Width and height of the compared renders if no cameras are known, pixels.
const COMPARED_SIZE: (u32, u32) = (640, 480);

/// A level that was written. Each PSNR compares renders with `1 / 2^level` of the pixels, as seen from correspondingly further away, with
/// the render of the whole scene at full size, downscaled by area; means over views, dB.
#[derive(Clone, Debug)]
pub struct Level {
    /// The file.
    pub path: PathBuf,
    /// Splats.
    pub splats: usize,
    /// Bytes of the file.
    pub bytes: u64,
    /// PSNR of the level.
    pub psnr: f64,
    /// PSNR of equally many splats taken evenly from the scene.
    pub subsample_psnr: f64,
    /// PSNR of the whole scene rendered at that size, where small splats are widened to a pixel each.
    pub whole_psnr: f64,
}

/// The file of level `level` of the scene in the file `path`: `a.lod1.sog` for `a.sog`.
///
/// # Errors
/// When the format is unknown, or is a folder of images.
pub fn level_file(path: &Path, level: u32) -> Result<PathBuf, RunError> {
    let format = SplatFormat::of(path)?;
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let stem = name.len().saturating_sub(format.suffix().len());
    match (format, name.get(..stem)) {
        (SplatFormat::SogFolder, _) | (_, None) => Err(RunError::Refused(format!(
            "{}: levels of detail need a scene in a single file: choose .sog",
            path.display()
        ))),
        (_, Some(stem)) => Ok(path.with_file_name(format!("{stem}.lod{level}{}", format.suffix()))),
    }
}

/// The files of the levels of the scene in the file `path`, whether they exist or not; none if its format has no levels.
pub(crate) fn level_files(path: &Path) -> impl Iterator<Item = PathBuf> {
    (1..=LEVELS).map_while(move |level| level_file(path, level).ok())
}

/// Writes a scene like [`write_splats_with`], and removes the levels of the scene that it replaces. If it replaces none, files with the
/// names of levels are somebody else's and stay: [`read_levels`] ignores levels that do not fit.
pub(crate) fn write_scene(path: &Path, cloud: &GaussianCloud, options: &WriteOptions) -> Result<Vec<String>, RunError> {
    let replaces = path.is_file();
    let notes = write_splats_with(path, cloud, options)?;
    if replaces {
        remove_levels(path)?;
    }
    Ok(notes)
}

/// Removes the levels of the scene in the file `path`.
pub(crate) fn remove_levels(path: &Path) -> Result<(), RunError> {
    for file in level_files(path).filter(|file| file.is_file()) {
        fs::remove_file(&file).map_err(RunError::io("remove", &file))?;
    }
    Ok(())
}

/// Writes the levels of the scene `input` beside `output`, and compares them in views of its training cameras.
///
/// # Errors
/// When the input cannot be read, or a level cannot be written.
pub fn write_levels(input: &Path, output: &Path, options: &WriteOptions) -> Result<Vec<Level>, RunError> {
    let paths = (1..=LEVELS)
        .map(|level| level_file(output, level))
        .collect::<Result<Vec<_>, _>>()?;
    let input = scene_path(input);
    let cloud = read_splats(&input)?;
    let whole = Splats::from_cloud(&cloud);
    let render = RenderOptions {
        antialias: cloud.antialiased,
        ..RenderOptions::default()
    };
    let cameras = compared_cameras(&input, &cloud, &whole);
    let mut renderer = Renderer::new();
    let mut picture = |splats: &Splats, camera: &Camera| {
        let frame = Model::of_splats(splats).render(&mut renderer, camera, &render);
        frame.color.to_u8()
    };
    let full: Vec<Vec<u8>> = cameras.iter().map(|camera| picture(&whole, camera)).collect();
    let (mut levels, mut last) = (Vec::new(), whole.clone());
    for (level, path) in (1..).zip(paths) {
        let count = whole.len().div_ceil(1 << level);
        last = merged(&last, count);
        let thinned: Vec<u32> = (0..whole.len() as u32).step_by(1 << level).collect();
        let subsample = whole.gather(&thinned);
        let mut sums = [0.0; 3];
        for (camera, full) in cameras.iter().zip(&full) {
            let k = &camera.intrinsics;
            let far = Camera {
                intrinsics: k.scaled(0.5f32.powf(0.5 * level as f32)),
                ..*camera
            };
            let [width, height] = [far.intrinsics.width, far.intrinsics.height];
            let shrunk = resize_area(full, 3, [k.width, k.height], [width, height]);
            for (sum, splats) in sums.iter_mut().zip([&last, &subsample, &whole]) {
                *sum += psnr_8_bits(&picture(splats, &far), &shrunk, None).expect("a frame has pixels");
            }
        }
        let [psnr, subsample_psnr, whole_psnr] = sums.map(|sum| sum / cameras.len().max(1) as f64);
        let merged = GaussianCloud {
            antialiased: cloud.antialiased,
            world_from_dataset: cloud.world_from_dataset,
            ..last.to_cloud()
        };
        write_splats_with(&path, &merged, options)?;
        levels.push(Level {
            splats: last.len(),
            bytes: splat_file_size(&path)?,
            path,
            psnr,
            subsample_psnr,
            whole_psnr,
        });
    }
    Ok(levels)
}

/// The levels beside the scene in the file `path`, which has `count` splats, in order; levels of another scene are ignored.
///
/// # Errors
/// When a level exists and cannot be read.
pub fn read_levels(path: &Path, count: usize) -> Result<Vec<Splats>, RunError> {
    let mut levels = Vec::new();
    for (level, file) in (1..).zip(level_files(path)) {
        if !file.is_file() {
            break;
        }
        let splats = Splats::from_cloud(&read_splats(&file)?);
        // Splats that are never seen are left out before merging, so there may be slightly fewer.
        let expected = count.div_ceil(1 << level);
        if splats.len() > expected || splats.len() < expected / 2 {
            break;
        }
        levels.push(splats);
    }
    Ok(levels)
}

/// Some of the training cameras, or cameras around the scene.
fn compared_cameras(input: &Path, cloud: &GaussianCloud, splats: &Splats) -> Vec<Camera> {
    match cameras_beside(input, &cloud.world_from_dataset) {
        Some(cameras) if !cameras.is_empty() => {
            let step = cameras.len().div_ceil(MAX_COMPARED_VIEWS as usize);
            cameras.into_iter().step_by(step).collect()
        }
        _ => orbit(Some(splats), None, MAX_COMPARED_VIEWS, Some(COMPARED_SIZE)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::convert;
    use irradia_formats::write_splats;
    use irradia_scene::Rng;

    #[test]
    fn levels_have_the_scenes_name_and_are_told_from_those_of_another() {
        let name = |path: &str| level_file(Path::new(path), 2).map(|path| path.display().to_string());
        assert_eq!(name("a/b.sog").unwrap(), "a/b.lod2.sog");
        assert_eq!(name("b.v1.Compressed.PLY").unwrap(), "b.v1.lod2.compressed.ply");
        assert!(name("meta.json").unwrap_err().to_string().contains("choose .sog"));

        let mut rng = Rng::new(3, 3);
        let count = 2000;
        let mut values = |n: usize, low: f32, high: f32| (0..n).map(|_| rng.range(low, high)).collect::<Vec<f32>>();
        let cloud = GaussianCloud {
            means: values(3 * count, -1.0, 1.0).as_chunks().0.to_vec(),
            quats: values(4 * count, 0.1, 1.0).as_chunks().0.to_vec(),
            log_scales: values(3 * count, -4.0, -3.0).as_chunks().0.to_vec(),
            opacity_logits: values(count, 0.0, 2.0),
            sh: values(3 * count, -1.0, 1.0),
            ..GaussianCloud::default()
        };
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.ply");
        write_splats(&path, &cloud).unwrap();
        let levels = write_levels(&path, &path, &WriteOptions::default()).unwrap();
        assert_eq!(
            levels.iter().map(|level| level.splats).collect::<Vec<_>>(),
            [1000, 500, 250]
        );
        for level in &levels {
            assert!(level.psnr > level.subsample_psnr + 3.0, "{level:?}");
        }
        let read = read_levels(&path, count).unwrap();
        assert_eq!(read.iter().map(Splats::len).collect::<Vec<_>>(), [1000, 500, 250]);
        assert!(read_levels(&path, 10 * count).unwrap().is_empty(), "of another scene");
        // A level does not replace its scene, whose other levels would be lost.
        let level = &levels[1].path;
        let error = convert(level, &path, &WriteOptions::default(), false).unwrap_err();
        assert!(
            error.to_string().contains("would be replaced") && level.is_file(),
            "{error}"
        );
        assert!(read_levels(&folder.path().join("b.ply"), count).unwrap().is_empty());
        // Levels go with the scene that is replaced; files that only look like levels stay.
        let single = GaussianCloud {
            means: vec![[0.0; 3]],
            quats: vec![[1.0, 0.0, 0.0, 0.0]],
            log_scales: vec![[0.0; 3]],
            opacity_logits: vec![0.0],
            sh: vec![0.0; 3],
            ..GaussianCloud::default()
        };
        let like_a_level = folder.path().join("c.lod1.ply");
        write_splats(&like_a_level, &single).unwrap();
        for name in ["a.ply", "c.ply"] {
            write_scene(&folder.path().join(name), &single, &WriteOptions::default()).unwrap();
        }
        assert!(like_a_level.is_file() && !level.exists());
    }
}
