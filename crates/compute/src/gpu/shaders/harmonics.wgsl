// The sixteen real harmonics of four bands, in the order and signs of `irradia_scene::sh`.
const C0: f32 = 0.28209479177387814;
const C1: f32 = 0.4886025119029199;
const C2: array<f32, 5> = array(1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396);
const C3: array<f32, 7> = array(
    -0.5900435899266435, 2.890611442640554, -0.4570457994644658, 0.3731763325901154, -0.4570457994644658, 1.445305721320277,
    -0.5900435899266435,
);

fn basis(degree: u32, d: vec3f) -> array<f32, 16> {
    var b: array<f32, 16>;
    for (var k = 0u; k < 16u; k++) {
        b[k] = 0.0;
    }
    let x = d.x;
    let y = d.y;
    let z = d.z;
    b[0] = C0;
    if degree >= 1u {
        b[1] = -C1 * y;
        b[2] = C1 * z;
        b[3] = -C1 * x;
    }
    let xx = x * x;
    let yy = y * y;
    let zz = z * z;
    if degree >= 2u {
        b[4] = C2[0] * x * y;
        b[5] = C2[1] * y * z;
        b[6] = C2[2] * (2.0 * zz - xx - yy);
        b[7] = C2[3] * x * z;
        b[8] = C2[4] * (xx - yy);
    }
    if degree >= 3u {
        b[9] = C3[0] * y * (3.0 * xx - yy);
        b[10] = C3[1] * x * y * z;
        b[11] = C3[2] * y * (4.0 * zz - xx - yy);
        b[12] = C3[3] * z * (2.0 * zz - 3.0 * (xx + yy));
        b[13] = C3[4] * x * (4.0 * zz - xx - yy);
        b[14] = C3[5] * z * (xx - yy);
        b[15] = C3[6] * x * (xx - 3.0 * yy);
    }
    return b;
}

// The gradient of the direction, given that of the basis.
fn basis_vjp(degree: u32, d: vec3f, v: ptr<function, array<f32, 16>>) -> vec3f {
    var g = vec3f(0.0);
    let x = d.x;
    let y = d.y;
    let z = d.z;
    if degree >= 1u {
        g = vec3f(-C1 * (*v)[3], -C1 * (*v)[1], C1 * (*v)[2]);
    }
    if degree >= 2u {
        let w0 = C2[0] * (*v)[4];
        let w1 = C2[1] * (*v)[5];
        let w2 = C2[2] * (*v)[6];
        let w3 = C2[3] * (*v)[7];
        let w4 = C2[4] * (*v)[8];
        g += vec3f(
            w0 * y + w3 * z + 2.0 * x * (w4 - w2),
            w0 * x + w1 * z - 2.0 * y * (w4 + w2),
            w1 * y + w3 * x + 4.0 * w2 * z,
        );
    }
    if degree >= 3u {
        let w0 = C3[0] * (*v)[9];
        let w1 = C3[1] * (*v)[10];
        let w2 = C3[2] * (*v)[11];
        let w3 = C3[3] * (*v)[12];
        let w4 = C3[4] * (*v)[13];
        let w5 = C3[5] * (*v)[14];
        let w6 = C3[6] * (*v)[15];
        let xx = x * x;
        let yy = y * y;
        let zz = z * z;
        let xy = x * y;
        let yz = y * z;
        let xz = x * z;
        g += vec3f(
            6.0 * w0 * xy + w1 * yz - 2.0 * w2 * xy - 6.0 * w3 * xz + w4 * (4.0 * zz - 3.0 * xx - yy)
                + 2.0 * w5 * xz + 3.0 * w6 * (xx - yy),
            3.0 * w0 * (xx - yy) + w1 * xz + w2 * (4.0 * zz - xx - 3.0 * yy) - 6.0 * w3 * yz - 2.0 * w4 * xy
                - 2.0 * w5 * yz - 6.0 * w6 * xy,
            w1 * xy + 8.0 * w2 * yz + 3.0 * w3 * (2.0 * zz - xx - yy) + 8.0 * w4 * xz + w5 * (xx - yy),
        );
    }
    return g;
}
