//! Principal axes of a covariance.

use glam::{Mat3, Quat, Vec3};

/// Rotation to the principal axes and the variances along them, of a symmetric matrix: cyclic Jacobi rotations, which at
/// this size converge to rounding in a few sweeps.
pub(crate) fn eigen(mut m: Mat3) -> (Quat, Vec3) {
    let mut axes = Mat3::IDENTITY;
    for _ in 0..6 {
        for (p, q) in [(0, 1), (0, 2), (1, 2)] {
            let off = m.col(q)[p];
            if off.abs() <= f32::MIN_POSITIVE {
                continue;
            }
            let theta = 0.5 * (2.0 * off).atan2(m.col(q)[q] - m.col(p)[p]);
            let (s, c) = theta.sin_cos();
            let mut turn = Mat3::IDENTITY;
            turn.col_mut(p)[p] = c;
            turn.col_mut(q)[q] = c;
            turn.col_mut(q)[p] = s;
            turn.col_mut(p)[q] = -s;
            m = turn.transpose() * m * turn;
            axes *= turn;
        }
    }
    if axes.determinant() < 0.0 {
        axes = Mat3::from_cols(axes.x_axis, axes.y_axis, -axes.z_axis);
    }
    (
        Quat::from_mat3(&axes).normalize(),
        Vec3::new(m.x_axis.x, m.y_axis.y, m.z_axis.z),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn principal_axes_reconstruct_the_matrix() {
        let turn = Mat3::from_quat(Quat::from_euler(glam::EulerRot::XYZ, 1.1, -0.7, 0.3));
        let m = turn * Mat3::from_diagonal(Vec3::new(4.0, 0.25, 1.0)) * turn.transpose();
        let (q, v) = eigen(m);
        let r = Mat3::from_quat(q);
        let again = r * Mat3::from_diagonal(v) * r.transpose();
        assert!(again.abs_diff_eq(m, 1e-5), "{again} {m}");
    }
}
