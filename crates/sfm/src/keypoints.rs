use glam::DVec2;

/// Bytes of a descriptor: 4 x 4 cells of 8 orientations.
pub const DESCRIPTOR_BYTES: usize = 128;

/// The position, scale and direction of a feature in a photograph.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Keypoint {
    /// Column, pixels of the photograph at full size; the first pixel's centre is at 0.5.
    pub x: f32,
    /// Row, pixels of the photograph at full size; the first pixel's centre is at 0.5.
    pub y: f32,
    /// Standard deviation of the feature's blob, pixels of the photograph at full size.
    pub scale: f32,
    /// Direction of the dominant gradient, radians from +x towards +y.
    pub angle: f32,
}

impl Keypoint {
    /// Its position, pixels.
    pub fn at(&self) -> DVec2 {
        DVec2::new(self.x.into(), self.y.into())
    }
}

/// Keypoints of one photograph and their descriptors.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Features {
    /// `[N]`, in a fixed order that does not depend on the number of threads.
    pub keypoints: Vec<Keypoint>,
    /// `[N, 128]` RootSIFT, bytes: 512 times the square root of the L1-normalised histogram, at most 255.
    pub descriptors: Vec<[u8; DESCRIPTOR_BYTES]>,
    /// `[N, 128]` descriptors of the same kind, of each feature's surroundings rectified to a frontal view; empty unless the extractor was
    /// configured to compute them.
    pub frontal: Vec<[u8; DESCRIPTOR_BYTES]>,
}

/// Stands for a missing descriptor: it matches nothing.
pub(crate) const NO_DESCRIPTOR: [u8; DESCRIPTOR_BYTES] = [0; DESCRIPTOR_BYTES];

/// Corresponding features of two photographs.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PairMatches {
    /// Indices of the two photographs, ascending.
    pub photos: [u32; 2],
    /// `[M]` indices of keypoints in the first and in the second photograph, sorted by the first; no keypoint occurs twice.
    pub matches: Vec<[u32; 2]>,
}
