//! Depth maps and normal maps given beside photographs: images of 8 or 16 bits, `OpenEXR`, and for depths `.npy` arrays.

use crate::FormatError;
use crate::dataset::parse_table;
use crate::error::read_and_parse;
use crate::image_file::{decode_normals, decode_values, read_header};
use crate::undistort::Undistortion;
use image::metadata::Orientation;
use irradia_scene::{Grid, GridSource, LoadError};
use std::path::PathBuf;

/// Cells of a grid along its longer side: about what a network or a phone's sensor resolves, at little memory (48 KB of depths per
/// photograph).
const CELLS_PER_SIDE: u32 = 128;

/// A map on disk with the operations to apply when it is loaded.
#[derive(Clone, Debug)]
pub(crate) struct MapFile {
    pub path: PathBuf,
    /// Orientation of the photograph.
    pub orientation: Orientation,
    /// Size of the upright photograph.
    pub upright_size: (u32, u32),
    /// Undistortion of the photograph, without a rotation: depths along +Z and normals keep their values.
    pub undistortion: Option<Undistortion>,
}

/// The pixels of a map: width, height and `[H, W]`.
type Values<T> = (u32, u32, Vec<T>);

impl GridSource<f32> for MapFile {
    fn load(&self) -> Result<Grid<f32>, LoadError> {
        let values = self.depths().map_err(|error| LoadError(error.to_string()))?;
        let mut grid = self.sample_grid(values, 0.0);
        grid.values
            .iter_mut()
            .filter(|value| !value.is_finite())
            .for_each(|value| *value = 0.0);
        Ok(grid)
    }
}

impl GridSource<[f32; 3]> for MapFile {
    fn load(&self) -> Result<Grid<[f32; 3]>, LoadError> {
        let values = self.normals().map_err(|error| LoadError(error.to_string()))?;
        Ok(self.sample_grid(values, [0.0; 3]))
    }
}

impl MapFile {
    /// The map as a grid over the photograph as it is trained on; `unknown` where the map has no value.
    fn sample_grid<T: Copy>(&self, (width, height, values): Values<T>, unknown: T) -> Grid<T> {
        let size = self.undistortion.map_or(self.upright_size, |plan| {
            let pinhole = plan.pinhole();
            (pinhole.width, pinhole.height)
        });
        let cell = (f64::from(size.0.max(size.1)) / f64::from(CELLS_PER_SIDE)).max(1.0);
        let [columns, rows] = [size.0, size.1].map(|side| ((f64::from(side) / cell).round() as u32).max(1));
        let value = |row: u32, column: u32| {
            let x = (f64::from(column) + 0.5) / f64::from(columns);
            let y = (f64::from(row) + 0.5) / f64::from(rows);
            let [x, y] = match &self.undistortion {
                None => [x, y],
                Some(plan) => plan.position_in_photo([x, y])?,
            };
            // The nearest value: a mean across an edge is the depth of neither side.
            let index = |at: f64, side: u32| ((at * f64::from(side)) as usize).min(side as usize - 1);
            Some(values[index(y, height) * width as usize + index(x, width)])
        };
        let cells = (0..rows).flat_map(|row| (0..columns).map(move |column| (row, column)));
        Grid {
            columns,
            rows,
            values: cells
                .map(|(row, column)| value(row, column).unwrap_or(unknown))
                .collect(),
        }
    }

    /// The depths, upright.
    fn depths(&self) -> Result<Values<f32>, FormatError> {
        if self.path.extension().is_some_and(|extension| extension == "npy") {
            let table = read_and_parse(&self.path, parse_table)?;
            if table.rows == 0 || table.columns == 0 {
                return Err(FormatError::malformed(&self.path, "has no values; create it again"));
            }
            let values = table.values.iter().map(|value| *value as f32).collect();
            return Ok((table.columns as u32, table.rows as u32, values));
        }
        let orientation = read_header(&self.path)?.orientation_from_photo(self.orientation, self.upright_size);
        decode_values(&self.path, orientation)
    }

    /// The normals. The file must be upright: if its pixels had to be rotated, so would the axes of its normals.
    fn normals(&self) -> Result<Values<[f32; 3]>, FormatError> {
        if !read_header(&self.path)?.has_aspect_of(self.upright_size) {
            let message = "is not upright like its photograph; create it again from the upright photograph";
            return Err(FormatError::malformed(&self.path, message));
        }
        decode_normals(&self.path)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::write_png_16;
    use irradia_scene::{Intrinsics, Lens};

    fn file(path: PathBuf) -> MapFile {
        MapFile {
            path,
            orientation: Orientation::NoTransforms,
            upright_size: (40, 20),
            undistortion: None,
        }
    }

    fn depths(file: &MapFile) -> Result<Grid<f32>, LoadError> {
        file.load()
    }

    #[test]
    fn normals_are_upright_colours() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.png");
        image::RgbImage::from_pixel(4, 2, image::Rgb([255, 0, 51]))
            .save(&path)
            .unwrap();
        let grid: Grid<[f32; 3]> = file(path.clone()).load().unwrap();
        assert_eq!((grid.columns, grid.rows), (40, 20));
        assert!(
            grid.values
                .iter()
                .all(|n| n[0] == 1.0 && n[1] == -1.0 && (n[2] + 0.6).abs() < 1e-6)
        );
        image::RgbImage::new(2, 4).save(&path).unwrap();
        let turned: Result<Grid<[f32; 3]>, _> = file(path).load();
        assert!(turned.unwrap_err().0.contains("not upright"));
    }

    #[test]
    fn grey_images_and_arrays_are_read_as_they_are_stored() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.png");
        let values: Vec<u16> = (0..40 * 20).map(|i| 60 * i + 7).collect();
        write_png_16(&path, 40, 20, &values).unwrap();
        let grid = depths(&file(path.clone())).unwrap();
        assert_eq!((grid.columns, grid.rows), (40, 20));
        assert!(
            grid.values
                .iter()
                .zip(&values)
                .all(|(got, wanted)| *got == f32::from(*wanted))
        );
        // A smaller map of the same photograph.
        image::GrayImage::from_raw(4, 2, (1..=8).collect())
            .unwrap()
            .save(&path)
            .unwrap();
        let grid = depths(&file(path.clone())).unwrap();
        assert_eq!((grid.values[0], grid.values[39], grid.values[799]), (1.0, 4.0, 8.0));
        image::RgbImage::from_fn(4, 2, |x, _| image::Rgb([3 * x as u8; 3]))
            .save(&path)
            .unwrap();
        assert_eq!(depths(&file(path.clone())).unwrap().values[39], 9.0);

        let array = folder.path().join("a.npy");
        let header = b"{'descr': '<f4', 'fortran_order': False, 'shape': (1, 2), }";
        let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
        bytes.extend((header.len() as u16).to_le_bytes());
        bytes.extend(header);
        bytes.extend([1.5f32, f32::NAN].into_iter().flat_map(f32::to_le_bytes));
        std::fs::write(&array, bytes).unwrap();
        let grid = depths(&file(array)).unwrap();
        assert_eq!((grid.values[0], grid.values[39]), (1.5, 0.0), "not a number is unknown");
    }

    #[test]
    fn pictures_in_colours_are_refused_in_one_line() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.png");
        image::RgbImage::from_fn(4, 2, |x, _| image::Rgb([x as u8, 0, 0]))
            .save(&path)
            .unwrap();
        let message = depths(&file(path)).unwrap_err().0;
        assert!(
            message.contains("a.png") && message.contains("not a map of values"),
            "{message}"
        );
    }

    #[test]
    fn a_map_is_undistorted_like_its_photograph() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.png");
        let bent = Intrinsics {
            lens: Lens::Opencv {
                k: [-0.2, 0.0, 0.0, 0.0, 0.0, 0.0],
                p: [0.0; 2],
            },
            ..Intrinsics::from_fov_x(200, 100, 1.2)
        };
        let column = |i: u16| 100 + i % 200;
        write_png_16(&path, 200, 100, &(0..200 * 100).map(column).collect::<Vec<_>>()).unwrap();
        let plan = Undistortion::plan(&bent).unwrap();
        let grid = MapFile {
            upright_size: (200, 100),
            undistortion: Some(plan),
            ..file(path)
        };
        let grid = depths(&grid).unwrap();
        for column in 0..grid.columns {
            let x = (f64::from(column) + 0.5) / f64::from(grid.columns);
            let row = grid.rows / 2;
            let y = (f64::from(row) + 0.5) / f64::from(grid.rows);
            let [place, _] = plan.position_in_photo([x, y]).unwrap();
            let got = f64::from(grid.values[(row * grid.columns + column) as usize]);
            assert!((got - 100.0 - 200.0 * place).abs() <= 1.0, "{x}: {got}");
        }
    }
}
