//! HEIC, the format of phones' photographs: images coded as HEVC in a HEIF container (ISO/IEC 23008-12), as an [`ImageDecoder`].

use crate::image_file::MAX_PIXELS;
use heifer::heifer_isobmff::boxes::Property;
use heifer::heifer_isobmff::{HeifFile, ItemId};
use heifer::{Options, decode_rgba8};
use image::error::{DecodingError, ImageFormatHint};
use image::metadata::Orientation;
use image::{ColorType, ImageDecoder, ImageError, ImageResult};

/// Many photographs are decoded at a time; more threads per photograph would only contend with each other.
const DECODE_OPTIONS: Options = Options {
    max_threads: 1,
    max_pixels: MAX_PIXELS,
};

/// Kinds of auxiliary images that hold alpha (ISO/IEC 23008-12, 6.5.8 and annex B).
const ALPHA_TYPES: [&str; 2] = [
    "urn:mpeg:hevc:2015:auxid:1",
    "urn:mpeg:mpegB:cicp:systems:auxiliary:alpha",
];

/// A HEIC file whose container has been read, but not its pixels.
pub(crate) struct HeicDecoder {
    bytes: Vec<u8>,
    size: (u32, u32),
    has_alpha: bool,
}

/// Whether a file that begins with `start` is a HEIF container; the codec of its images is declared further inside.
pub(crate) fn is_heif(start: &[u8]) -> bool {
    const BRANDS: [&[u8]; 6] = [b"heic", b"heix", b"heim", b"heis", b"mif1", b"mif2"];
    start.get(4..8) == Some(b"ftyp") && start.get(8..12).is_some_and(|brand| BRANDS.contains(&brand))
}

impl HeicDecoder {
    /// Reads the container of a file's `bytes`.
    ///
    /// # Errors
    /// When it is damaged, or ends before the images that it lists.
    pub fn new(bytes: Vec<u8>) -> ImageResult<Self> {
        let (size, has_alpha) = read_container(&bytes).map_err(undecodable)?;
        Ok(Self { bytes, size, has_alpha })
    }
}

/// The size of the primary image as displayed, and whether it has alpha.
fn read_container(bytes: &[u8]) -> Result<((u32, u32), bool), heifer::Error> {
    let file = HeifFile::parse(bytes)?;
    let picture = file.primary_id;
    // A photograph is a grid of tiles, each of them an item.
    for &item in [picture].iter().chain(file.referenced_items(picture, b"dimg")) {
        file.item_data(item)?;
    }
    let is_alpha = |item: ItemId| {
        file.item_properties(item).is_ok_and(|mut properties| {
            properties.any(
                |property| matches!(property, Property::AuxiliaryType(kind) if ALPHA_TYPES.contains(&kind.as_str())),
            )
        })
    };
    let has_alpha = file.referencing_items(picture, b"auxl").into_iter().any(is_alpha);
    let (width, height) = displayed_size(&file, picture)?;
    if u64::from(width) * u64::from(height) > MAX_PIXELS {
        return Err(heifer::Error::Invalid("more than 268 megapixels"));
    }
    Ok(((width, height), has_alpha))
}

/// The size of an image after it is cropped and rotated, in the order that its file gives.
fn displayed_size(file: &HeifFile, picture: ItemId) -> Result<(u32, u32), heifer::Error> {
    let no_size = heifer::Error::Invalid("no size");
    let (mut width, mut height) = file.image_size(picture)?.ok_or(no_size)?;
    for property in file.item_properties(picture)? {
        match *property {
            Property::CleanAperture {
                width: aperture_width,
                height: aperture_height,
                horiz_offset,
                vert_offset,
            } => {
                width = cropped(width, aperture_width, horiz_offset);
                height = cropped(height, aperture_height, vert_offset);
            }
            Property::Rotation(quarters) if quarters % 2 == 1 => (width, height) = (height, width),
            _ => {}
        }
    }
    Ok((width, height))
}

/// The number of `side` pixels that remain in an aperture of `length` pixels, `offset` from the middle; both are given as fractions.
fn cropped(side: u32, length: (u32, u32), offset: (i32, u32)) -> u32 {
    let length = f64::from(length.0) / f64::from(length.1);
    let middle = f64::from(offset.0) / f64::from(offset.1) + (f64::from(side) - 1.0) / 2.0;
    let start = (middle - (length - 1.0) / 2.0).round().max(0.0) as u32;
    (length.round() as u32).min(side.saturating_sub(start))
}

impl ImageDecoder for HeicDecoder {
    fn dimensions(&self) -> (u32, u32) {
        self.size
    }

    fn color_type(&self) -> ColorType {
        if self.has_alpha {
            ColorType::Rgba8
        } else {
            ColorType::Rgb8
        }
    }

    fn exif_metadata(&mut self) -> ImageResult<Option<Vec<u8>>> {
        let metadata = heifer::read_metadata(&self.bytes).map_err(undecodable)?;
        Ok(metadata.exif)
    }

    /// Always none: the container declares the rotation, and its decoder applies it. EXIF orientation is only informative.
    fn orientation(&mut self) -> ImageResult<Orientation> {
        Ok(Orientation::NoTransforms)
    }

    fn read_image(self, out: &mut [u8]) -> ImageResult<()> {
        let picture = decode_rgba8(&self.bytes, &DECODE_OPTIONS).map_err(undecodable)?;
        if (picture.width, picture.height) != self.size {
            return Err(undecodable(heifer::Error::Invalid("not of the size that it declares")));
        }
        let channels = usize::from(self.color_type().channel_count());
        for (to, from) in out.chunks_exact_mut(channels).zip(picture.data.as_chunks::<4>().0) {
            to.copy_from_slice(&from[..channels]);
        }
        Ok(())
    }

    fn read_image_boxed(self: Box<Self>, out: &mut [u8]) -> ImageResult<()> {
        (*self).read_image(out)
    }
}

fn undecodable(error: heifer::Error) -> ImageError {
    ImageError::Decoding(DecodingError::new(ImageFormatHint::Name("HEIC".to_owned()), error))
}

#[cfg(test)]
mod tests {
    use super::*;
    use heifer::{EncodeOptions, Metadata, encode_with_metadata};

    /// A photograph of a smooth gradient, 96 x 64, with and without alpha.
    fn photograph(alpha: bool, exif: Option<Vec<u8>>) -> Vec<u8> {
        let mut picture = heifer::Image::filled(96, 64, 8, [0, 0, 0, 255]);
        picture.has_alpha = alpha;
        for (i, pixel) in picture.data.as_chunks_mut::<4>().0.iter_mut().enumerate() {
            let (x, y) = ((i % 96) as u16, (i / 96) as u16);
            *pixel = [2 * x, 3 * y, 90, if alpha { 255 - 2 * x } else { 255 }];
        }
        let metadata = Metadata {
            exif,
            ..Metadata::default()
        };
        encode_with_metadata(&picture, &metadata, &EncodeOptions::default()).unwrap()
    }

    fn decode(bytes: Vec<u8>) -> ImageResult<image::DynamicImage> {
        HeicDecoder::new(bytes).and_then(image::DynamicImage::from_decoder)
    }

    #[test]
    fn a_photograph_is_decoded_with_its_size_alpha_and_metadata() {
        let block = b"MM\0\x2a\0\0\0\x08\0\0\0\0\0\0".to_vec();
        for alpha in [false, true] {
            let bytes = photograph(alpha, Some(block.clone()));
            assert!(is_heif(&bytes));
            let mut decoder = HeicDecoder::new(bytes).unwrap();
            assert_eq!((decoder.dimensions(), decoder.has_alpha), ((96, 64), alpha));
            assert_eq!(decoder.exif_metadata().unwrap().as_deref(), Some(&block[..]));
            let image = image::DynamicImage::from_decoder(decoder).unwrap();
            assert_eq!(image.color().has_alpha(), alpha);
            for (x, y, pixel) in image.to_rgba8().enumerate_pixels() {
                let truth = [2 * x, 3 * y, 90, if alpha { 255 - 2 * x } else { 255 }];
                for (got, wanted) in pixel.0.into_iter().zip(truth) {
                    assert!(
                        u32::from(got).abs_diff(wanted) < 12,
                        "{x}, {y}: {:?}, not {truth:?}",
                        pixel.0
                    );
                }
            }
        }
    }

    #[test]
    fn the_size_is_that_of_the_cropped_picture() {
        assert_eq!(cropped(100, (60, 1), (0, 1)), 60);
        assert_eq!(cropped(100, (121, 2), (10, 1)), 61);
        assert_eq!(cropped(100, (60, 1), (40, 1)), 40, "what lies outside is not there");
        assert!(
            cropped(100, (60, 0), (0, 0)) <= 100,
            "a damaged one, which the decoder refuses"
        );
    }

    #[test]
    fn damaged_files_are_errors() {
        let whole = photograph(true, None);
        for length in 0..whole.len() {
            assert!(decode(whole[..length].to_vec()).is_err(), "cut to {length} bytes");
        }
        // Pixels may be wrong, but nothing panics.
        for i in 0..whole.len() {
            let mut bytes = whole.clone();
            bytes[i] ^= 1 << (i % 8);
            drop(decode(bytes));
        }
    }
}
