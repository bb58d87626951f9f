use glam::Vec3;

/// Coloured points, such as structure from motion produces.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PointCloud {
    /// `[N]` world.
    pub positions: Vec<Vec3>,
    /// `[N]` sRGB, 8 bits.
    pub colors: Vec<[u8; 3]>,
}

impl PointCloud {
    /// Number of points.
    pub fn len(&self) -> usize {
        self.positions.len()
    }

    /// Whether there are no points.
    pub fn is_empty(&self) -> bool {
        self.positions.is_empty()
    }
}
