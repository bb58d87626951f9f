use crate::complete::{jpeg_is_complete, png_is_complete};
use crate::{FormatError, write_atomic};
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::metadata::Orientation;
use image::{DynamicImage, ExtendedColorType, ImageDecoder, ImageEncoder, ImageReader};
use std::fs::File;
use std::io::{self, BufRead, BufReader, Cursor, Read, Seek};
use std::path::Path;

/// An image with 8 bits per channel.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Pixels {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// 1 (grey), 3 (sRGB) or 4 (sRGB and straight alpha).
    pub channels: u32,
    /// `[H, W, channels]`.
    pub data: Vec<u8>,
}

/// The header of an image file, read before its pixels are decoded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Header {
    /// As stored, before orientation.
    pub width: u32,
    /// As stored, before orientation.
    pub height: u32,
    /// The EXIF orientation to apply to see the picture upright.
    pub orientation: Orientation,
}

/// Target channels of decoded pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Colour {
    /// Three channels, or four if the file has alpha.
    Keep,
    /// One channel.
    Grey,
}

/// Reads a JPEG or PNG of any depth as 3 or (if the file has alpha) 4 channels of 8 bits, with the EXIF orientation applied.
///
/// # Errors
/// When the file cannot be read, is not an image, or is truncated.
pub fn read_image(path: &Path) -> Result<Pixels, FormatError> {
    let header = read_header(path)?;
    decode(path, header.orientation, Colour::Keep)
}

/// Writes an 8-bit PNG of 1, 3 or 4 channels, atomically.
///
/// # Errors
/// When the file cannot be written, or the sizes do not match.
pub fn write_png(path: &Path, width: u32, height: u32, channels: u32, data: &[u8]) -> Result<(), FormatError> {
    let color = match channels {
        1 => ExtendedColorType::L8,
        3 => ExtendedColorType::Rgb8,
        4 => ExtendedColorType::Rgba8,
        _ => {
            return Err(FormatError::Option(format!(
                "a PNG has 1, 3 or 4 channels, not {channels}"
            )));
        }
    };
    if width == 0 || height == 0 || data.len() as u64 != u64::from(width) * u64::from(height) * u64::from(channels) {
        return Err(FormatError::Option(format!(
            "{}: {} bytes do not make a {width}x{height} image of {channels} channels",
            path.display(),
            data.len()
        )));
    }
    write_atomic(path, |out| {
        PngEncoder::new_with_quality(out, CompressionType::Fast, FilterType::Adaptive)
            .write_image(data, width, height, color)
            .map_err(io::Error::other)
    })
}

/// Writes a 16-bit grey PNG, atomically.
///
/// # Errors
/// When the file cannot be written, or the sizes do not match.
pub fn write_png_16(path: &Path, width: u32, height: u32, data: &[u16]) -> Result<(), FormatError> {
    if width == 0 || height == 0 || data.len() as u64 != u64::from(width) * u64::from(height) {
        return Err(FormatError::Option(format!(
            "{}: {} values do not make a {width}x{height} image",
            path.display(),
            data.len()
        )));
    }
    // The codec expects 16-bit samples in native byte order.
    let bytes: Vec<u8> = data.iter().flat_map(|v| v.to_ne_bytes()).collect();
    write_atomic(path, |out| {
        PngEncoder::new(out)
            .write_image(&bytes, width, height, ExtendedColorType::L16)
            .map_err(io::Error::other)
    })
}

/// Size and orientation, without decoding the pixels. The format is detected by content, not by extension.
pub(crate) fn read_header(path: &Path) -> Result<Header, FormatError> {
    let mut decoder = open(path)?;
    let (width, height) = decoder.dimensions();
    if width == 0 || height == 0 {
        return Err(FormatError::malformed(
            path,
            format!("an image of {width}x{height} pixels"),
        ));
    }
    // A broken EXIF block does not make a picture unusable.
    let orientation = decoder.orientation().unwrap_or(Orientation::NoTransforms);
    Ok(Header {
        width,
        height,
        orientation,
    })
}

/// The pixels, with `orientation` applied.
pub(crate) fn decode(path: &Path, orientation: Orientation, colour: Colour) -> Result<Pixels, FormatError> {
    let decoder = open(path)?;
    let mut image = DynamicImage::from_decoder(decoder).map_err(|error| undecodable(path, &error))?;
    image.apply_orientation(orientation);
    let (width, height) = (image.width(), image.height());
    let (channels, data) = match colour {
        Colour::Grey => (1, image.into_luma8().into_raw()),
        Colour::Keep if image.color().has_alpha() => (4, image.into_rgba8().into_raw()),
        Colour::Keep => (3, image.into_rgb8().into_raw()),
    };
    Ok(Pixels {
        width,
        height,
        channels,
        data,
    })
}

/// A decoder's input: a file, or bytes already read.
trait Source: BufRead + Seek {}
impl<T: BufRead + Seek> Source for T {}

/// Opens an image that is not truncated; the format is detected by its first bytes.
fn open(path: &Path) -> Result<impl ImageDecoder + use<>, FormatError> {
    let (source, complete) = open_source(path).map_err(|source| FormatError::Read {
        path: path.to_owned(),
        source,
    })?;
    if !complete {
        return Err(FormatError::malformed(
            path,
            "the image ends too early; the file is truncated, copy it again or remove it",
        ));
    }
    let reader = ImageReader::new(source)
        .with_guessed_format()
        .map_err(|source| FormatError::Read {
            path: path.to_owned(),
            source,
        })?;
    reader.into_decoder().map_err(|error| undecodable(path, &error))
}

fn open_source(path: &Path) -> io::Result<(Box<dyn Source>, bool)> {
    let mut reader = BufReader::new(File::open(path)?);
    let start = reader.fill_buf()?;
    if start.starts_with(&[0xFF, 0xD8]) {
        // The decoder would read all of it anyway.
        let mut bytes = Vec::new();
        reader.read_to_end(&mut bytes)?;
        let complete = jpeg_is_complete(&bytes);
        return Ok((Box::new(Cursor::new(bytes)), complete));
    }
    let complete = !start.starts_with(b"\x89PNG") || png_is_complete(&mut reader)?;
    reader.rewind()?;
    Ok((Box::new(reader), complete))
}

fn undecodable(path: &Path, error: &image::ImageError) -> FormatError {
    FormatError::malformed(
        path,
        format!("not a readable JPEG or PNG image ({error}); restore or remove it"),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn png_round_trips_for_every_channel_count_and_bad_sizes_are_rejected() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.png");
        for channels in [1u32, 3, 4] {
            let data: Vec<u8> = (0..5 * 3 * channels).map(|i| (i * 7) as u8).collect();
            write_png(&path, 5, 3, channels, &data).unwrap();
            let back = read_image(&path).unwrap();
            assert_eq!((back.width, back.height, back.channels), (5, 3, channels.max(3)));
            if channels == 1 {
                assert!(back.data.chunks(3).zip(&data).all(|(rgb, grey)| rgb == [*grey; 3]));
            } else {
                assert_eq!(back.data, data);
            }
        }
        assert!(write_png(&path, 5, 3, 2, &[0; 30]).is_err());
        assert!(write_png(&path, 5, 3, 3, &[0; 44]).is_err());
        assert!(write_png(&path, 0, 3, 3, &[]).is_err());
        let deep = [0u16, 1, 256, 65535, 4660, 7];
        write_png_16(&path, 3, 2, &deep).unwrap();
        assert_eq!(image::open(&path).unwrap().into_luma16().as_raw()[..], deep);
        assert!(write_png_16(&path, 3, 3, &deep).is_err());
    }

    #[test]
    fn palettes_sixteen_bits_and_grey_alpha_become_eight_bit_colour() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.png");
        let grey_alpha: image::ImageBuffer<image::LumaA<u16>, _> =
            image::ImageBuffer::from_raw(2, 1, vec![0u16, 65535, 65535, 32896]).unwrap();
        DynamicImage::ImageLumaA16(grey_alpha).save(&path).unwrap();
        let back = read_image(&path).unwrap();
        assert_eq!(
            (back.channels, &back.data[..]),
            (4, &[0, 0, 0, 255, 255, 255, 255, 128][..])
        );
    }

    #[test]
    fn truncated_images_are_errors_that_name_the_file() {
        let folder = tempfile::tempdir().unwrap();
        let data: Vec<u8> = (0..64 * 64 * 3).map(|i| (i * i / 7) as u8).collect();
        let buffer = image::RgbImage::from_raw(64, 64, data).unwrap();
        for name in ["a.png", "a.jpg"] {
            let path = folder.path().join(name);
            buffer.save(&path).unwrap();
            let bytes = std::fs::read(&path).unwrap();
            for keep in [0, 3, 20, bytes.len() / 2, bytes.len() - 1] {
                std::fs::write(&path, &bytes[..keep]).unwrap();
                let error = read_image(&path)
                    .err()
                    .unwrap_or_else(|| panic!("{name} cut to {keep} bytes"));
                assert!(error.to_string().contains(name), "{error}");
            }
        }
    }
}
