/// A float image, row-major, channels interleaved.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct Image {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// Channels per pixel.
    pub channels: u32,
    /// Values, `[H, W, C]`; colour is sRGB-encoded in \[0, 1\].
    pub data: Vec<f32>,
}

impl Image {
    /// An image filled with zeros.
    pub fn zeros(width: u32, height: u32, channels: u32) -> Self {
        Self {
            width,
            height,
            channels,
            data: vec![0.0; width as usize * height as usize * channels as usize],
        }
    }

    /// Wraps `data [H, W, C]`.
    ///
    /// # Panics
    /// When the length does not match: a bug in the caller.
    pub fn new(width: u32, height: u32, channels: u32, data: Vec<f32>) -> Self {
        assert_eq!(
            data.len(),
            width as usize * height as usize * channels as usize,
            "image data length"
        );
        Self {
            width,
            height,
            channels,
            data,
        }
    }

    /// The channels of the pixel in column `x`, row `y`.
    pub fn pixel(&self, x: u32, y: u32) -> &[f32] {
        let c = self.channels as usize;
        let at = (y as usize * self.width as usize + x as usize) * c;
        &self.data[at..at + c]
    }

    /// Values clamped to \[0, 1\] and rounded to 8 bits, `[H, W, C]`.
    pub fn to_u8(&self) -> Vec<u8> {
        self.data
            .iter()
            .map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8)
            .collect()
    }

    /// The image as an 8-bit file would hold it: clamped, rounded to 1/255. Metrics are computed on this.
    pub fn rounded_to_8_bits(&self) -> Self {
        Self {
            data: self
                .data
                .iter()
                .map(|v| (v.clamp(0.0, 1.0) * 255.0).round() / 255.0)
                .collect(),
            ..*self
        }
    }
}
