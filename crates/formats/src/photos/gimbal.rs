//! The up direction, from the angles of its gimbal that a drone writes into its photographs.

use crate::xml::{parse_xml, property};
use glam::DVec3;

/// The up direction in the axes of the stored image (x right, y down, z forward), from the pitch and roll that cameras by DJI write into
/// their photographs' XMP: degrees, pitch 0 for level and -90 for straight down. `None` if they are absent or damaged.
pub fn parse_gimbal(xmp: &[u8]) -> Option<DVec3> {
    let document = parse_xml(xmp).ok()?;
    let angle = |name: &str| {
        let degrees: f64 = property(&document, name)?.trim().parse().ok()?;
        (degrees.abs() <= 360.0).then(|| degrees.to_radians().sin_cos())
    };
    let (pitch_sin, pitch_cos) = angle("drone-dji:GimbalPitchDegree")?;
    let (roll_sin, roll_cos) = angle("drone-dji:GimbalRollDegree")?;
    Some(DVec3::new(-pitch_cos * roll_sin, -pitch_cos * roll_cos, pitch_sin))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn up(pitch: &str, roll: &str) -> Option<DVec3> {
        let packet = format!(
            "<?xpacket begin=\"\u{feff}\" id=\"W5M0MpCehiHzreSzNTczkc9d\"?><x:xmpmeta xmlns:x=\"adobe:ns:meta/\"><rdf:RDF>
            <rdf:Description drone-dji:GimbalRollDegree=\"{roll}\">
            <drone-dji:GimbalPitchDegree>{pitch}</drone-dji:GimbalPitchDegree></rdf:Description></rdf:RDF></x:xmpmeta><?xpacket end=\"w\"?>\0"
        );
        parse_gimbal(packet.as_bytes())
    }

    #[test]
    fn pitch_and_roll_tell_where_up_is() {
        let near = |angles: [&str; 2], expected: [f64; 3]| {
            let up = up(angles[0], angles[1]).expect("known");
            assert!((up - DVec3::from(expected)).length() < 1e-9, "{angles:?}: {up}");
        };
        near(["+0.00", "+0.00"], [0.0, -1.0, 0.0]);
        // Straight down: forward is down.
        near(["-90.00", "+0.00"], [0.0, 0.0, -1.0]);
        // Rolled to the right: up is to the image's left.
        near(["0", "90"], [-1.0, 0.0, 0.0]);
        // Tilted past straight down is the same as before it, rotated by half a turn.
        near(["-60", "180"], [0.0, 0.5, -0.75f64.sqrt()]);
    }

    #[test]
    fn damaged_angles_are_none() {
        for angles in [["", "0"], ["-90", "nan"], ["1e300", "0"], ["-90", "north"]] {
            assert_eq!(up(angles[0], angles[1]), None, "{angles:?}");
        }
        assert_eq!(parse_gimbal(b"<a/>"), None);
        assert_eq!(parse_gimbal(b"<a"), None);
    }
}
