//! `OpenEXR`: linear colours from renderers, as an [`ImageDecoder`], and depths and normals from renderers and phones, as stored.

use crate::image_file::MAX_PIXELS;
use exr::error::Error;
use exr::image::{AnyChannel, FlatSamples};
use exr::meta::MetaData;
use exr::meta::header::Header;
use exr::prelude::{ReadChannels, ReadLayers, Vec2, read};
use image::error::{DecodingError, ImageFormatHint};
use image::{ColorType, ImageDecoder, ImageError, ImageResult};
use irradia_scene::srgb_from_linear;
use std::io::{BufRead, Read, Seek, SeekFrom};

/// Maximum number of decoded bytes per byte of a file, more than the best compression achieves (of a single colour, about 1,000 to one).
const MAX_DECODED_PER_BYTE: u64 = 4096;
/// Last parts of the names of channels that hold depths, in order of preference.
const DEPTH_CHANNELS: [&str; 5] = ["Z", "Depth", "V", "Y", "R"];

/// A file whose header has been read, but not its pixels.
pub(crate) struct ExrDecoder<R> {
    source: R,
    size: [usize; 2],
    has_alpha: bool,
}

/// Values of a channel, `[H, W]`.
type Plane = Vec<f32>;

/// Width, height and values of three channels, `[H, W, 3]`.
type Vectors = (u32, u32, Vec<[f32; 3]>);

/// Whether a file that begins with `start` is in this format.
pub(crate) fn is_exr(start: &[u8]) -> bool {
    start.starts_with(&[0x76, 0x2F, 0x31, 0x01])
}

impl<R: BufRead + Seek> ExrDecoder<R> {
    /// Reads the header of `source` and the offsets of its pixels.
    ///
    /// # Errors
    /// When it is damaged or ends too early, or has only layers of several samples per pixel ("deep").
    pub fn new(mut source: R) -> ImageResult<Self> {
        let (size, has_alpha) = read_header(&mut source).map_err(undecodable)?;
        Ok(Self {
            source,
            size,
            has_alpha,
        })
    }

    /// Depths: width, height and `[H, W]`. `None` if the file holds colours.
    pub fn read_depths(self) -> ImageResult<Option<(u32, u32, Plane)>> {
        let size = self.size.map(|side| side as u32);
        let mut channels = self.read_channels().map_err(undecodable)?;
        let named = DEPTH_CHANNELS.iter().find_map(|name| channels.position(&[name]));
        let Some(at) = named.or((channels.planes.len() == 1).then_some(0)) else {
            return Ok(None);
        };
        let is_color = channels
            .colors()
            .is_some_and(|rgb| rgb.contains(&at) && rgb.iter().any(|c| channels.planes[*c].1 != channels.planes[at].1));
        Ok((!is_color).then(|| (size[0], size[1], channels.planes.swap_remove(at).1)))
    }

    /// Three channels as they are stored. `None` if there are not three.
    pub fn read_vectors(self) -> ImageResult<Option<Vectors>> {
        let size = self.size.map(|side| side as u32);
        let channels = self.read_channels().map_err(undecodable)?;
        let Some(positions) = channels.colors().or_else(|| channels.find_in_layer(["X", "Y", "Z"])) else {
            return Ok(None);
        };
        let planes = positions.map(|at| &channels.planes[at].1);
        let vector = |i: usize| planes.map(|plane| plane[i]);
        Ok(Some((size[0], size[1], (0..planes[0].len()).map(vector).collect())))
    }

    fn read_channels(mut self) -> Result<Channels, Error> {
        self.source.rewind()?;
        let image = read()
            .no_deep_data()
            .largest_resolution_level()
            .all_channels()
            .first_valid_layer()
            .all_attributes()
            .non_parallel()
            .from_buffered(&mut self.source)?;
        let (layer, window) = (image.layer_data, image.attributes.display_window);
        let (size, offset) = (layer.size, layer.attributes.layer_position - window.position);
        let place = |channel: AnyChannel<FlatSamples>| {
            // Subsampled channels are chroma differences.
            let is_whole = channel.sampling == Vec2(1, 1) && channel.sample_data.len() == size.area();
            is_whole.then(|| {
                (
                    channel.name.to_string(),
                    placed_in_image(&channel.sample_data, size, offset, self.size),
                )
            })
        };
        Ok(Channels {
            planes: layer.channel_data.list.into_iter().filter_map(place).collect(),
        })
    }
}

/// The size of the image, and whether it has alpha.
fn read_header(source: &mut (impl BufRead + Seek)) -> Result<([usize; 2], bool), Error> {
    let meta = MetaData::read_from_buffered(&mut *source, false)?;
    // The offset table of the blocks of pixels: a truncated file ends before its last block.
    let blocks: usize = meta.headers.iter().map(|header| header.chunk_count).sum();
    let mut table = Vec::new();
    (&mut *source).take(8 * blocks as u64).read_to_end(&mut table)?;
    let last = table
        .as_chunks::<8>()
        .0
        .iter()
        .map(|bytes| u64::from_le_bytes(*bytes))
        .max();
    let end = source.seek(SeekFrom::End(0))?;
    if table.len() != 8 * blocks || last.is_none_or(|last| last >= end) {
        return Err(Error::Invalid("the file ends too early".into()));
    }
    let is_picture = |header: &&Header| !header.deep;
    let header = meta
        .headers
        .iter()
        .find(is_picture)
        .ok_or(Error::NotSupported("deep data".into()))?;
    let Vec2(width, height) = header.shared_attributes.display_window.size;
    let area = |size: Vec2<usize>| size.0.saturating_mul(size.1);
    let pixels = area(header.layer_size).max(width.saturating_mul(height)) as u64;
    let decoded = pixels.saturating_mul(header.channels.bytes_per_pixel as u64);
    if pixels > MAX_PIXELS || width.min(height) == 0 || decoded / MAX_DECODED_PER_BYTE > end {
        return Err(Error::NotSupported(
            format!("{width}x{height} pixels in {end} bytes").into(),
        ));
    }
    let channels = Channels {
        planes: header
            .channels
            .list
            .iter()
            .map(|channel| (channel.name.to_string(), Plane::new()))
            .collect(),
    };
    Ok(([width, height], channels.alpha().is_some()))
}

/// The samples of a layer of `size` pixels at `offset`, placed in an image of `to` pixels; zero outside the layer.
fn placed_in_image(samples: &FlatSamples, size: Vec2<usize>, offset: Vec2<i32>, to: [usize; 2]) -> Plane {
    let values: Plane = samples.values_as_f32().collect();
    if (size, offset) == (Vec2(to[0], to[1]), Vec2(0, 0)) {
        return values;
    }
    let value = |x: usize, y: usize| {
        let at = [x as i64 - i64::from(offset.0), y as i64 - i64::from(offset.1)];
        let inside = (0..size.0 as i64).contains(&at[0]) && (0..size.1 as i64).contains(&at[1]);
        if inside {
            values[at[1] as usize * size.0 + at[0] as usize]
        } else {
            0.0
        }
    };
    (0..to[1])
        .flat_map(|y| (0..to[0]).map(move |x| (x, y)))
        .map(|(x, y)| value(x, y))
        .collect()
}

/// Channels by name. The part of a name after the last dot is the channel's own name; the part before it is its layer's.
struct Channels {
    planes: Vec<(String, Plane)>,
}

impl Channels {
    /// The first channel whose own name is one of `names`.
    fn position(&self, names: &[&str]) -> Option<usize> {
        let is_named = |name: &str| {
            names.iter().any(|wanted| {
                name.rsplit('.')
                    .next()
                    .is_some_and(|own| own.eq_ignore_ascii_case(wanted))
            })
        };
        self.planes.iter().position(|(name, _)| is_named(name))
    }

    /// The channels with these names in one layer.
    fn find_in_layer(&self, names: [&str; 3]) -> Option<[usize; 3]> {
        self.planes.iter().find_map(|(name, _)| {
            let layer = name
                .strip_suffix(names[0])
                .filter(|layer| layer.is_empty() || layer.ends_with('.'))?;
            let at = |own: &str| {
                self.planes
                    .iter()
                    .position(|(name, _)| name.strip_prefix(layer) == Some(own))
            };
            let [a, b, c] = names.map(at);
            Some([a?, b?, c?])
        })
    }

    /// Red, green and blue.
    fn colors(&self) -> Option<[usize; 3]> {
        self.find_in_layer(["R", "G", "B"])
    }

    /// The alpha of the colours' layer.
    fn alpha(&self) -> Option<usize> {
        let red = &self.planes[self.colors()?[0]].0;
        let alpha = format!("{}A", &red[..red.len() - 1]);
        self.planes.iter().position(|(name, _)| *name == alpha)
    }
}

/// The 8-bit sRGB value of a linear one; values above 1 are white.
fn srgb_byte(linear: f32) -> u8 {
    // NaN becomes zero in the conversion.
    (255.0 * srgb_from_linear(linear.clamp(0.0, 1.0))).round() as u8
}

impl<R: BufRead + Seek> ImageDecoder for ExrDecoder<R> {
    fn dimensions(&self) -> (u32, u32) {
        (self.size[0] as u32, self.size[1] as u32)
    }

    fn color_type(&self) -> ColorType {
        if self.has_alpha {
            ColorType::Rgba8
        } else {
            ColorType::Rgb8
        }
    }

    /// Linear values from 0 to 1 as sRGB, grey if there is one channel. Stored colours are multiplied by alpha; the result's are not.
    fn read_image(self, out: &mut [u8]) -> ImageResult<()> {
        let has_alpha = self.has_alpha;
        let channels = self.read_channels().map_err(undecodable)?;
        let grey = || {
            channels
                .position(&["Y", "R"])
                .or((channels.planes.len() == 1).then_some(0))
                .map(|at| [at; 3])
        };
        let rgb = channels
            .colors()
            .or_else(grey)
            .ok_or_else(|| undecodable(Error::Invalid("no colours".into())))?;
        let alpha = channels.alpha().filter(|_| has_alpha);
        let count = if has_alpha { 4 } else { 3 };
        for (i, to) in out.chunks_exact_mut(count).enumerate() {
            let coverage = alpha.map_or(1.0, |at| channels.planes[at].1[i]);
            for (to, at) in to.iter_mut().zip(rgb) {
                *to = srgb_byte(channels.planes[at].1[i] / if coverage > 0.0 { coverage } else { 1.0 });
            }
            if has_alpha {
                to[3] = (255.0 * coverage.clamp(0.0, 1.0)).round() as u8;
            }
        }
        Ok(())
    }

    fn read_image_boxed(self: Box<Self>, out: &mut [u8]) -> ImageResult<()> {
        (*self).read_image(out)
    }
}

fn undecodable(error: Error) -> ImageError {
    ImageError::Decoding(DecodingError::new(ImageFormatHint::Name("OpenEXR".into()), error))
}

#[cfg(test)]
mod tests {
    use super::*;
    use exr::prelude::{AnyChannels, Encoding, Image, Layer, LayerAttributes, WritableImage};
    use exr::prelude::{SmallVec, f16};
    use image::DynamicImage;
    use std::io::Cursor;

    /// A file with one layer of `size` pixels with these channels, at `offset` in an image of `shown` pixels.
    fn file(size: [usize; 2], offset: [i32; 2], shown: [usize; 2], channels: &[(&str, FlatSamples)]) -> Vec<u8> {
        let list: SmallVec<[AnyChannel<FlatSamples>; 4]> = channels
            .iter()
            .map(|(name, samples)| AnyChannel::new(*name, samples.clone()))
            .collect();
        let attributes = LayerAttributes {
            layer_position: Vec2(offset[0], offset[1]),
            ..LayerAttributes::default()
        };
        let layer = Layer::new(
            Vec2(size[0], size[1]),
            attributes,
            Encoding::SMALL_FAST_LOSSLESS,
            AnyChannels::sort(list),
        );
        let mut image = Image::from_layer(layer);
        image.attributes.display_window.position = Vec2(0, 0);
        image.attributes.display_window.size = Vec2(shown[0], shown[1]);
        let mut bytes = Cursor::new(Vec::new());
        image.write().non_parallel().to_buffered(&mut bytes).unwrap();
        bytes.into_inner()
    }

    fn decoder(bytes: &[u8]) -> ImageResult<ExrDecoder<Cursor<&[u8]>>> {
        ExrDecoder::new(Cursor::new(bytes))
    }

    fn floats(values: &[f32]) -> FlatSamples {
        FlatSamples::F32(values.to_vec())
    }

    #[test]
    fn linear_colours_become_srgb_and_premultiplied_alpha_straight() {
        let channels = [
            ("R", floats(&[0.214_041_14, 0.107_020_57])),
            ("G", floats(&[1.0, 0.0])),
            ("B", floats(&[7.0, f32::NAN])),
            ("A", floats(&[1.0, 0.5])),
        ];
        let bytes = file([2, 1], [0, 0], [2, 1], &channels);
        assert!(is_exr(&bytes));
        let image = DynamicImage::from_decoder(decoder(&bytes).unwrap()).unwrap();
        assert_eq!(image.into_rgba8().into_raw(), [128, 255, 255, 255, 128, 0, 0, 128]);
        let bytes = file([2, 1], [0, 0], [2, 1], &channels[..3]);
        let image = DynamicImage::from_decoder(decoder(&bytes).unwrap()).unwrap();
        assert_eq!(image.color(), image::ColorType::Rgb8);
        assert!(decoder(&bytes).unwrap().read_depths().unwrap().is_none());
        let (_, _, vectors) = decoder(&bytes).unwrap().read_vectors().unwrap().unwrap();
        assert_eq!(vectors[0], [0.214_041_14, 1.0, 7.0]);
    }

    #[test]
    fn a_layer_smaller_than_the_picture_lies_at_its_place() {
        let bytes = file([2, 1], [1, 1], [3, 2], &[("Y", floats(&[1.0, 1.0]))]);
        let image = DynamicImage::from_decoder(decoder(&bytes).unwrap())
            .unwrap()
            .into_luma8();
        assert_eq!(
            (image.dimensions(), image.into_raw()),
            ((3, 2), vec![0, 0, 0, 0, 255, 255])
        );
    }

    #[test]
    fn depths_are_the_values_of_one_channel() {
        let metres = [0.5f32, 1.25, 2.0, 0.0];
        let half = FlatSamples::F16(metres.iter().map(|v| f16::from_f32(*v)).collect());
        let color = floats(&[0.1; 4]);
        for channels in [
            vec![("R", half)],
            vec![("ViewLayer.Depth.Z", floats(&metres)), ("ViewLayer.Combined.R", color)],
            ["R", "G", "B"].map(|name| (name, floats(&metres))).to_vec(),
        ] {
            let read = decoder(&file([2, 2], [0, 0], [2, 2], &channels)).unwrap().read_depths();
            assert_eq!(read.unwrap().unwrap(), (2, 2, metres.to_vec()), "{}", channels[0].0);
        }
    }

    #[test]
    fn files_that_end_too_early_are_refused() {
        let values: Vec<f32> = (0..32 * 32).map(|i| (i * i % 977) as f32).collect();
        let bytes = file([32, 32], [0, 0], [32, 32], &[("Y", floats(&values))]);
        for keep in [4, 40, bytes.len() / 3, bytes.len() / 2, bytes.len() - 1] {
            let read = decoder(&bytes[..keep]).and_then(ExrDecoder::read_depths);
            assert!(read.is_err(), "{keep} of {} bytes", bytes.len());
        }
        let mut damaged = bytes.clone();
        for i in 0..bytes.len() {
            damaged[i] ^= 0x5A;
            let _ = decoder(&damaged).and_then(DynamicImage::from_decoder);
            damaged[i] ^= 0x5A;
        }
    }
}
