//! Depth maps of many frames in one range, which is known after the last frame: until then they wait on disk, not in memory.

use anyhow::{Context, Result};
use irradia_runs::scene::Image;
use std::fs::File;
use std::io::{BufReader, BufWriter, IntoInnerError, Read, Seek, Write};
use std::path::{Path, PathBuf};

/// The inverse depths of frames; distant parts, usually most of the scene, get few levels of their range.
pub struct Depths {
    folder: PathBuf,
    /// Little-endian `f32`, frame after frame.
    spool: BufWriter<File>,
    /// Name, width and height of each frame.
    frames: Vec<(String, u32, u32)>,
    /// The largest inverse depth of all frames.
    nearest: f32,
}

impl Depths {
    /// Begins in `folder`, on whose disk the frames wait: 4 bytes per pixel.
    pub fn begin(folder: &Path) -> Result<Self> {
        // It has no name, and disappears when the program ends, however it ends.
        let file = tempfile::tempfile_in(folder).with_context(|| disk_space_message(folder))?;
        Ok(Self {
            folder: folder.to_owned(),
            spool: BufWriter::new(file),
            frames: Vec::new(),
            nearest: 0.0,
        })
    }

    /// Adds a frame of `width` x `height` pixels.
    pub fn add(&mut self, name: &str, (width, height): (u32, u32), inverse: impl Iterator<Item = f32>) -> Result<()> {
        for value in inverse {
            self.nearest = self.nearest.max(value);
            let written = self.spool.write_all(&value.to_le_bytes());
            written.with_context(|| disk_space_message(&self.folder))?;
        }
        self.frames.push((name.to_owned(), width, height));
        Ok(())
    }

    /// Passes name and picture of each frame to `write`; the nearest pixel of all frames is 1.
    pub fn finish(self, mut write: impl FnMut(&str, &Image) -> Result<()>) -> Result<()> {
        let context = || disk_space_message(&self.folder);
        let file = self.spool.into_inner().map_err(IntoInnerError::into_error);
        let mut file = file.with_context(context)?;
        file.rewind().with_context(context)?;
        let mut spool = BufReader::new(file);
        for (name, width, height) in &self.frames {
            let mut bytes = vec![0u8; 4 * *width as usize * *height as usize];
            spool.read_exact(&mut bytes).with_context(context)?;
            let values = bytes.as_chunks::<4>().0.iter().map(|bytes| f32::from_le_bytes(*bytes));
            let data = values.map(|value| value / self.nearest.max(1e-20)).collect();
            write(name, &Image::new(*width, *height, 1, data))?;
        }
        Ok(())
    }
}

fn disk_space_message(folder: &Path) -> String {
    format!(
        "cannot keep depths in {}, where they need 4 bytes per pixel of all frames",
        folder.display()
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    #[test]
    fn frames_come_back_in_one_range_and_leave_no_file() {
        let folder = tempfile::tempdir().expect("a folder");
        let mut depths = Depths::begin(folder.path()).expect("begun");
        depths.add("near", (2, 1), [0.5, 4.0].into_iter()).expect("added");
        depths.add("far", (1, 3), [0.0, 1.0, 2.0].into_iter()).expect("added");
        let mut seen = Vec::new();
        let finished = depths.finish(|name, image| {
            seen.push((name.to_owned(), image.clone()));
            Ok(())
        });
        finished.expect("finished");
        let near = Image::new(2, 1, 1, vec![0.125, 1.0]);
        let far = Image::new(1, 3, 1, vec![0.0, 0.25, 0.5]);
        assert_eq!(seen, [("near".to_owned(), near), ("far".to_owned(), far)]);
        assert_eq!(fs::read_dir(folder.path()).expect("a folder").count(), 0);
    }
}
