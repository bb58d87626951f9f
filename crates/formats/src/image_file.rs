use crate::complete::{jpeg_file_is_complete, jpeg_is_complete, png_is_complete};
use crate::heic::{HeicDecoder, is_heif};
use crate::open_exr::{ExrDecoder, is_exr};
use crate::{FormatError, write_atomic};
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::metadata::Orientation;
use image::{
    DynamicImage, ExtendedColorType, GrayImage, ImageDecoder, ImageEncoder, ImageReader, Rgb, Rgb32FImage, RgbImage,
};
use irradia_scene::resize_area;
use std::fs::File;
use std::io::{self, BufRead, BufReader, Cursor, Read, Seek};
use std::path::Path;

/// Maximum number of pixels, above the largest renders and the sensors of phones (200 megapixels); a damaged file may declare any size.
pub(crate) const MAX_PIXELS: u64 = 1 << 28;

/// Minimum value of a colour's largest channel for it not to be black in a mask: the palettes of PASCAL VOC and DAVIS begin with 64 and 128.
const MIN_COLOR: u8 = 16;

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

impl Pixels {
    /// The pixels without their alpha, if they have any.
    pub(crate) fn without_alpha(mut self) -> Self {
        if self.channels == 4 {
            self.data = self.data.chunks_exact(4).flat_map(|p| [p[0], p[1], p[2]]).collect();
            self.channels = 3;
        }
        self
    }

    /// Whether all pixels have an alpha of 255; false without alpha.
    pub(crate) fn has_opaque_alpha(&self) -> bool {
        self.channels == 4 && self.data.chunks_exact(4).all(|pixel| pixel[3] == 255)
    }
}

/// The header of an image file, read before its pixels are decoded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Header {
    /// As stored, before orientation.
    pub width: u32,
    /// As stored, before orientation.
    pub height: u32,
    /// The EXIF orientation to apply for an upright image.
    pub orientation: Orientation,
    /// Whether it is a JPEG, which can be decoded at a fraction of its size.
    pub jpeg: bool,
}

/// Reads a JPEG, PNG, WebP, TIFF, HEIC or `OpenEXR` of any depth as 3 or (if the file has alpha) 4 channels of 8 bits, with the EXIF
/// orientation applied.
///
/// # Errors
/// When the file cannot be read, is not an image, or is truncated.
pub fn read_image(path: &Path) -> Result<Pixels, FormatError> {
    let header = read_header(path)?;
    decode(path, header.orientation)
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

impl Header {
    /// Whether the stored image is landscape or portrait like an image of `upright` size.
    pub fn has_aspect_of(&self, (width, height): (u32, u32)) -> bool {
        (self.width > self.height) == (width > height)
    }

    /// The orientation to apply to this mask or map of a photograph that has the orientation `photograph` and the size `upright_size`.
    /// Masks and maps are made from the pixels as some tool displays them and rarely have EXIF data, so one with the aspect of the stored
    /// photograph is rotated like it.
    pub fn orientation_from_photo(&self, photograph: Orientation, upright_size: (u32, u32)) -> Orientation {
        if self.has_aspect_of(upright_size) {
            Orientation::NoTransforms
        } else {
            photograph
        }
    }
}

/// Size and orientation, without the pixels. The format is detected by content, not by extension.
pub(crate) fn read_header(path: &Path) -> Result<Header, FormatError> {
    if let Some(header) = read_jpeg_header(path)? {
        return Ok(header);
    }
    let (mut decoder, jpeg) = open(path)?;
    let (width, height) = decoder.dimensions();
    if width == 0 || height == 0 {
        return Err(FormatError::malformed(
            path,
            format!("an image of {width}x{height} pixels"),
        ));
    }
    // A broken EXIF block does not make an image unusable.
    let orientation = decoder.orientation().unwrap_or(Orientation::NoTransforms);
    Ok(Header {
        width,
        height,
        orientation,
        jpeg,
    })
}

/// The header of a JPEG; reads only the file's headers and end. `None` if it is not a JPEG, or needs the other decoder.
fn read_jpeg_header(path: &Path) -> Result<Option<Header>, FormatError> {
    let read_error = |source| FormatError::Read {
        path: path.to_owned(),
        source,
    };
    let mut reader = BufReader::new(File::open(path).map_err(read_error)?);
    if !reader.fill_buf().map_err(read_error)?.starts_with(&[0xFF, 0xD8]) {
        return Ok(None);
    }
    if !jpeg_file_is_complete(&mut reader).map_err(read_error)? {
        return Err(truncated(path));
    }
    reader.rewind().map_err(read_error)?;
    let mut decoder = jpeg_decoder::Decoder::new(reader);
    let size = decoder.read_info().ok().and_then(|()| decoder.info());
    let exif = decoder.exif_data().and_then(Orientation::from_exif_chunk);
    let Some(info) = size.filter(|info| info.width > 0 && info.height > 0) else {
        return Ok(None);
    };
    let (width, height) = (info.width.into(), info.height.into());
    check_size(path, width, height)?;
    Ok(Some(Header {
        width,
        height,
        orientation: exif.unwrap_or(Orientation::NoTransforms),
        jpeg: true,
    }))
}

/// What cameras write beside the pixels; empty if nothing can be read.
#[derive(Default)]
pub(crate) struct Metadata {
    /// The EXIF block, beginning with its TIFF header.
    pub(crate) exif: Option<Vec<u8>>,
    /// The XMP packet.
    pub(crate) xmp: Option<Vec<u8>>,
}

/// The metadata of an image, in one pass over its headers.
pub(crate) fn read_metadata(path: &Path) -> Metadata {
    let read = || {
        let mut reader = BufReader::new(File::open(path).ok()?);
        if reader.fill_buf().ok()?.starts_with(&[0xFF, 0xD8]) {
            let mut decoder = jpeg_decoder::Decoder::new(reader);
            decoder.read_info().ok()?;
            return Some(Metadata {
                exif: decoder.exif_data().map(<[u8]>::to_vec),
                xmp: decoder.xmp_data().map(<[u8]>::to_vec),
            });
        }
        let mut decoder = open(path).ok()?.0;
        Some(Metadata {
            exif: decoder.exif_metadata().ok().flatten(),
            xmp: decoder.xmp_metadata().ok().flatten(),
        })
    };
    read().unwrap_or_default()
}

/// The pixels, with `orientation` applied: three channels, or four if the file has alpha.
pub(crate) fn decode(path: &Path, orientation: Orientation) -> Result<Pixels, FormatError> {
    Ok(pixels(decode_oriented(path, orientation)?.0))
}

/// The image with `orientation` applied, and whether it is a JPEG.
fn decode_oriented(path: &Path, orientation: Orientation) -> Result<(DynamicImage, bool), FormatError> {
    let (decoder, jpeg) = open(path)?;
    let mut image = DynamicImage::from_decoder(decoder).map_err(|error| undecodable(path, &error))?;
    image.apply_orientation(orientation);
    Ok((image, jpeg))
}

/// The pixels of a mask, 0 to 255. Where masks are not black and white, black is ignored and all else is kept: labels (0, 1, 2, ..),
/// colours and palettes, at any depth. The alpha of an image of a single colour is the mask.
pub(crate) fn decode_mask(path: &Path, orientation: Orientation) -> Result<Pixels, FormatError> {
    let (image, jpeg) = decode_oriented(path, orientation)?;
    let (width, height) = (image.width(), image.height());
    let data = alpha_of_single_color(&image).unwrap_or_else(|| {
        // A JPEG's black is not exact, so its labels cannot be told from noise.
        if jpeg {
            image.to_luma8().into_raw()
        } else {
            mask_values(&image)
        }
    });
    Ok(Pixels {
        width,
        height,
        channels: 1,
        data,
    })
}

/// The alpha of an image whose colour is the same everywhere, if it varies.
fn alpha_of_single_color(image: &DynamicImage) -> Option<Vec<u8>> {
    if !image.color().has_alpha() {
        return None;
    }
    let pixels = image.to_rgba8();
    let first = pixels.pixels().next()?.0;
    let is_single = pixels.pixels().all(|pixel| pixel.0[..3] == first[..3]);
    let varies = pixels.pixels().any(|pixel| pixel.0[3] != first[3]);
    (is_single && varies).then(|| pixels.pixels().map(|pixel| pixel.0[3]).collect())
}

/// The values of a mask without losses: 255 for all that is not black if it holds labels or colours, otherwise its brightness.
fn mask_values(image: &DynamicImage) -> Vec<u8> {
    if image.color().has_color() {
        let pixels = image.to_rgb8();
        if pixels.pixels().any(|pixel| grey(pixel.0).is_none()) {
            let is_black = |channels: [u8; 3]| channels.iter().all(|channel| *channel < MIN_COLOR);
            let value = |pixel: &Rgb<u8>| if is_black(pixel.0) { 0 } else { 255 };
            return pixels.pixels().map(value).collect();
        }
    }
    let levels = image.to_luma16();
    let has_labels = levels.iter().all(|level| *level < 1 << 15);
    let value = |level: &u16| match (has_labels, level) {
        (true, 0) => 0,
        (true, _) => 255,
        (false, level) => (level >> 8) as u8,
    };
    levels.iter().map(value).collect()
}

/// The pixels of a HEIC image in memory.
pub(crate) fn decode_heic(bytes: &[u8]) -> Result<Pixels, image::ImageError> {
    Ok(pixels(DynamicImage::from_decoder(HeicDecoder::new(bytes.to_vec())?)?))
}

/// The pixels of an `OpenEXR` image in memory.
pub(crate) fn decode_exr(bytes: &[u8]) -> Result<Pixels, image::ImageError> {
    Ok(pixels(DynamicImage::from_decoder(ExrDecoder::new(Cursor::new(
        bytes,
    ))?)?))
}

/// The values of a grey image as stored (8 bits, 16 bits or `OpenEXR`): width, height and `[H, W]`.
///
/// # Errors
/// When it cannot be decoded or is in colour.
pub(crate) fn decode_values(path: &Path, orientation: Orientation) -> Result<(u32, u32, Vec<f32>), FormatError> {
    let color_error = || {
        let message = "is a colour image, not a map of values; store the values as 8- or 16-bit grey, single-channel OpenEXR, or .npy";
        FormatError::malformed(path, message)
    };
    if let Some(decoder) = open_exr(path)? {
        let read = decoder.read_depths().map_err(|error| undecodable(path, &error))?;
        let (width, height, values) = read.ok_or_else(color_error)?;
        // Three equal channels, since an image of one float channel cannot be rotated.
        let tripled = values.into_iter().flat_map(|value| [value; 3]).collect();
        let image = Rgb32FImage::from_raw(width, height, tripled).ok_or_else(color_error)?;
        let mut image = DynamicImage::from(image);
        image.apply_orientation(orientation);
        let values = image.to_rgb32f().pixels().map(|pixel| pixel.0[0]).collect();
        return Ok((image.width(), image.height(), values));
    }
    let (image, _) = decode_oriented(path, orientation)?;
    let (width, height) = (image.width(), image.height());
    let values: Vec<f32> = if image.color().bytes_per_pixel() > image.color().channel_count() {
        let rgb = image.to_rgb16();
        rgb.pixels().map_while(|pixel| grey(pixel.0)).map(f32::from).collect()
    } else {
        let rgb = image.to_rgb8();
        rgb.pixels().map_while(|pixel| grey(pixel.0)).map(f32::from).collect()
    };
    if values.len() != width as usize * height as usize {
        return Err(color_error());
    }
    Ok((width, height, values))
}

/// The normals in an image: width, height and `[H, W]`. `OpenEXR` stores the values themselves, other files colours, `n = 2 c - 1`.
///
/// # Errors
/// When it cannot be decoded, or is an `OpenEXR` without three channels of one layer.
pub(crate) fn decode_normals(path: &Path) -> Result<(u32, u32, Vec<[f32; 3]>), FormatError> {
    if let Some(decoder) = open_exr(path)? {
        let vectors = decoder.read_vectors().map_err(|error| undecodable(path, &error))?;
        return vectors
            .ok_or_else(|| FormatError::malformed(path, "lacks the channels R, G, B or X, Y, Z; create it again"));
    }
    let (decoder, _) = open(path)?;
    let image = DynamicImage::from_decoder(decoder).map_err(|error| undecodable(path, &error))?;
    let colors = image.to_rgb32f();
    Ok((
        image.width(),
        image.height(),
        colors
            .pixels()
            .map(|pixel| pixel.0.map(|value| 2.0 * value - 1.0))
            .collect(),
    ))
}

/// The value of a grey colour; `None` for other colours.
fn grey<T: PartialEq + Copy>([red, green, blue]: [T; 3]) -> Option<T> {
    (red == green && green == blue).then_some(red)
}

/// The pixels of `image`: three channels, or four if it has alpha.
fn pixels(image: DynamicImage) -> Pixels {
    let (width, height) = (image.width(), image.height());
    let (channels, data) = if image.color().has_alpha() {
        (4, image.into_rgba8().into_raw())
    } else {
        (3, image.into_rgb8().into_raw())
    };
    Pixels {
        width,
        height,
        channels,
        data,
    }
}

/// The pixels of a JPEG at 1 / `divisor` of its size, rounded up, with `orientation` applied. For `divisor` 2, 4 or 8, only the low
/// frequencies of each block of 8 x 8 pixels are transformed (ITU-T T.81, A.3.3), which takes a fraction of the time and memory.
pub(crate) fn decode_jpeg_scaled(path: &Path, divisor: u32, orientation: Orientation) -> Result<Pixels, FormatError> {
    let read_error = |source| FormatError::Read {
        path: path.to_owned(),
        source,
    };
    let jpeg_error = |error: jpeg_decoder::Error| {
        FormatError::malformed(
            path,
            format!("not a readable JPEG image ({error}); restore or remove it"),
        )
    };
    let bytes = std::fs::read(path).map_err(read_error)?;
    if !jpeg_is_complete(&bytes) {
        return Err(truncated(path));
    }
    let mut decoder = jpeg_decoder::Decoder::new(&bytes[..]);
    decoder.read_info().map_err(jpeg_error)?;
    let [full_width, full_height] = decoder.info().map_or([0; 2], |info| [info.width, info.height]);
    check_size(path, full_width.into(), full_height.into())?;
    let size = [full_width, full_height].map(|side| u32::from(side).div_ceil(divisor).max(1));
    decoder.scale(size[0] as u16, size[1] as u16).map_err(jpeg_error)?;
    let data = decoder.decode().map_err(jpeg_error)?;
    let info = decoder
        .info()
        .filter(|info| [info.width, info.height].map(u32::from) == size);
    let [width, height] = size;
    let image = match info.map(|info| info.pixel_format) {
        Some(jpeg_decoder::PixelFormat::L8) => GrayImage::from_raw(width, height, data).map(DynamicImage::from),
        Some(jpeg_decoder::PixelFormat::RGB24) => RgbImage::from_raw(width, height, data).map(DynamicImage::from),
        // Other pixel formats are rare: decoded at full size, then averaged.
        _ => None,
    };
    if let Some(mut image) = image {
        image.apply_orientation(orientation);
        return Ok(pixels(image));
    }
    let full = decode(path, orientation)?;
    let to = [full.width.div_ceil(divisor), full.height.div_ceil(divisor)];
    Ok(Pixels {
        width: to[0],
        height: to[1],
        channels: full.channels,
        data: resize_area(&full.data, full.channels, [full.width, full.height], to),
    })
}

fn truncated(path: &Path) -> FormatError {
    FormatError::malformed(
        path,
        "the image ends too early; the file is truncated, copy it again or remove it",
    )
}

/// A decoder's input: a file, or bytes already read.
trait Source: BufRead + Seek {}
impl<T: BufRead + Seek> Source for T {}

/// The decoder of an `OpenEXR` file; `None` if it has another format.
fn open_exr(path: &Path) -> Result<Option<ExrDecoder<BufReader<File>>>, FormatError> {
    let read_error = |source| FormatError::Read {
        path: path.to_owned(),
        source,
    };
    let mut reader = BufReader::new(File::open(path).map_err(read_error)?);
    if !is_exr(reader.fill_buf().map_err(read_error)?) {
        return Ok(None);
    }
    let decoder = ExrDecoder::new(reader).map_err(|error| undecodable(path, &error))?;
    Ok(Some(decoder))
}

/// Opens an image, and returns whether it is a JPEG; the format is detected by the first bytes. A truncated file is an error.
fn open(path: &Path) -> Result<(Box<dyn ImageDecoder>, bool), FormatError> {
    let read_error = |source| FormatError::Read {
        path: path.to_owned(),
        source,
    };
    let mut reader = BufReader::new(File::open(path).map_err(read_error)?);
    let start = reader.fill_buf().map_err(read_error)?;
    if is_exr(start) {
        let decoder = ExrDecoder::new(reader).map_err(|error| undecodable(path, &error))?;
        return Ok((Box::new(decoder), false));
    }
    if is_heif(start) {
        let mut bytes = Vec::new();
        reader.read_to_end(&mut bytes).map_err(read_error)?;
        let decoder = HeicDecoder::new(bytes).map_err(|error| undecodable(path, &error))?;
        return Ok((Box::new(decoder), false));
    }
    let (source, complete, jpeg) = complete_source(reader).map_err(read_error)?;
    if !complete {
        return Err(truncated(path));
    }
    let reader = ImageReader::new(source).with_guessed_format().map_err(read_error)?;
    let decoder = reader.into_decoder().map_err(|error| undecodable(path, &error))?;
    let (width, height) = decoder.dimensions();
    check_size(path, width, height)?;
    Ok((Box::new(decoder), jpeg))
}

/// Refuses an image of more than [`MAX_PIXELS`] pixels before they are decoded.
fn check_size(path: &Path, width: u32, height: u32) -> Result<(), FormatError> {
    if u64::from(width) * u64::from(height) <= MAX_PIXELS {
        return Ok(());
    }
    let limit = MAX_PIXELS / 1_000_000;
    let message =
        format!("an image of {width}x{height} pixels, more than {limit} megapixels; make it smaller or remove it");
    Err(FormatError::malformed(path, message))
}

/// The file, whether it is complete, and whether it is a JPEG.
fn complete_source(mut reader: BufReader<File>) -> io::Result<(Box<dyn Source>, bool, bool)> {
    let start = reader.fill_buf()?;
    if start.starts_with(&[0xFF, 0xD8]) {
        // The decoder would read all of it anyway.
        let mut bytes = Vec::new();
        reader.read_to_end(&mut bytes)?;
        let complete = jpeg_is_complete(&bytes);
        return Ok((Box::new(Cursor::new(bytes)), complete, true));
    }
    let complete = !start.starts_with(b"\x89PNG") || png_is_complete(&mut reader)?;
    reader.rewind()?;
    Ok((Box::new(reader), complete, false))
}

fn undecodable(path: &Path, error: &image::ImageError) -> FormatError {
    FormatError::malformed(
        path,
        format!("not a readable JPEG, PNG, WebP, TIFF, HEIC or OpenEXR image ({error}); restore or remove it"),
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
    fn a_jpeg_at_a_fraction_of_its_size_is_its_mean() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.jpg");
        let smooth = |x: u32, y: u32| image::Rgb([(x * 2) as u8, (y * 3) as u8, 90]);
        image::RgbImage::from_fn(101, 67, smooth).save(&path).unwrap();
        let full = read_image(&path).unwrap();
        for divisor in [2, 4, 8] {
            let small = decode_jpeg_scaled(&path, divisor, Orientation::NoTransforms).unwrap();
            let to = [101u32.div_ceil(divisor), 67u32.div_ceil(divisor)];
            assert_eq!([small.width, small.height], to);
            let block = |x: u32, y: u32, c: u32| {
                let at = |x: u32, y: u32| f64::from(full.data[((y * 101 + x) * 3 + c) as usize]);
                let sum: f64 = (0..divisor * divisor)
                    .map(|i| at(x * divisor + i % divisor, y * divisor + i / divisor))
                    .sum();
                sum / f64::from(divisor * divisor)
            };
            for (x, y, c) in [(1, 1, 0), (3, 2, 1), (5, 5, 2)] {
                let got = f64::from(small.data[((y * to[0] + x) * 3 + c) as usize]);
                assert!(
                    (got - block(x, y, c)).abs() < 4.0,
                    "{divisor} {x} {y} {c}: {got}, not {}",
                    block(x, y, c)
                );
            }
            let turned = decode_jpeg_scaled(&path, divisor, Orientation::Rotate90).unwrap();
            assert_eq!([turned.width, turned.height], [to[1], to[0]]);
        }
        let bytes = std::fs::read(&path).unwrap();
        std::fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
        assert!(
            decode_jpeg_scaled(&path, 2, Orientation::NoTransforms)
                .unwrap_err()
                .to_string()
                .contains("truncated")
        );
    }

    #[test]
    fn a_small_file_that_declares_a_huge_image_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.jpg");
        image::RgbImage::new(16, 16).save(&path).unwrap();
        let mut bytes = std::fs::read(&path).unwrap();
        // The frame's header: marker, length, precision, height and width.
        let frame = bytes.windows(2).position(|marker| marker == [0xFF, 0xC0]).unwrap();
        bytes[frame + 5..frame + 9].copy_from_slice(&[0xFF, 0xDC, 0xFF, 0xDC]);
        std::fs::write(&path, bytes).unwrap();
        let upright = Orientation::NoTransforms;
        for result in [
            read_header(&path).map(|_| ()),
            decode(&path, upright).map(|_| ()),
            decode_jpeg_scaled(&path, 8, upright).map(|_| ()),
        ] {
            let error = result.unwrap_err().to_string();
            assert!(
                error.contains("65500x65500 pixels, more than 268 megapixels"),
                "{error}"
            );
        }
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
