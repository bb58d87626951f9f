use glam::DVec3;

/// A similarity without rotation between two coordinate systems, in `f64`: `to = scale (from - center)`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Similarity {
    /// Units of the target per unit of the source; positive.
    pub scale: f64,
    /// The target's origin, in the source's coordinates.
    pub center: DVec3,
}

impl Similarity {
    /// The identity.
    pub const IDENTITY: Self = Self {
        scale: 1.0,
        center: DVec3::ZERO,
    };

    /// Whether it changes nothing.
    pub fn is_identity(&self) -> bool {
        *self == Self::IDENTITY
    }

    /// Whether the scale is positive and all numbers are finite.
    pub fn is_valid(&self) -> bool {
        self.scale > 0.0 && self.scale.is_finite() && self.center.is_finite()
    }

    /// A point of the source in the target's coordinates.
    pub fn apply(&self, point: DVec3) -> DVec3 {
        self.scale * (point - self.center)
    }

    /// A point of the target in the source's coordinates.
    pub fn invert(&self, point: DVec3) -> DVec3 {
        point / self.scale + self.center
    }
}

impl Default for Similarity {
    fn default() -> Self {
        Self::IDENTITY
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_millimetre_survives_500_kilometres() {
        let world_from_dataset = Similarity {
            scale: 1e-3,
            center: DVec3::new(5e8, -5e8, 1e5),
        };
        let point = DVec3::new(5e8 + 1234.0, -5e8 + 1.0, 1e5);
        let world = world_from_dataset.apply(point).as_vec3();
        assert!((world.as_dvec3() - DVec3::new(1.234, 1e-3, 0.0)).length() < 1e-7);
        assert!((world_from_dataset.invert(world.as_dvec3()) - point).length() < 1e-3);
        assert!(!world_from_dataset.is_identity() && Similarity::default().is_identity());
    }
}
