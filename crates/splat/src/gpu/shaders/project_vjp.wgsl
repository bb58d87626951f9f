// The vector-Jacobian product of projection, from the sums of blending: the twin of `project_vjp` in `render/project.rs`.
@group(0) @binding(0) var<uniform> view: View;
// Place of each visible splat, front to back.
@group(0) @binding(1) var<storage, read> places: array<u32>;
@group(0) @binding(2) var<storage, read> firsts: array<u32>;
@group(0) @binding(3) var<storage, read> touched: array<u32>;
@group(0) @binding(4) var<storage, read> sums: array<vec4f>;
@group(0) @binding(5) var<storage, read> footprints: array<vec4f>;
@group(0) @binding(6) var<storage, read> geometry: array<f32>;
@group(0) @binding(7) var<storage, read> harmonics: array<f32>;
@group(0) @binding(8) var<storage, read> filter_variance: array<f32>;
// Planes: geometry 0..11, colour 11..14, screen 14..16, gathered 16..18.
@group(0) @binding(9) var<storage, read_write> v_splats: array<f32>;
@group(0) @binding(10) var<storage, read_write> visible: array<u32>;
// Numbers of visible splats, of tile entries, and of splats whose gradient is not finite.
@group(0) @binding(11) var<storage, read_write> found: array<atomic<u32>>;
// Planes, by place in `order`: the gradients of R, of t, and of the centre through viewing directions.
@group(0) @binding(12) var<storage, read_write> v_camera: array<f32>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) thread: u32) {
    // In the order of the splats, not front to back, so that neighbouring threads access neighbouring words of the planes.
    let i = group_index(group, groups) * 64u + thread;
    if i >= view.splats.x || visible[i] == 0u {
        return;
    }
    let j = places[i];
    // In a void frame, which had no room for its entries, no splat counts as visible.
    if j >= view.found.x {
        return;
    }
    var s = array<vec4f, 3>();
    let first = firsts[j];
    for (var slot = first; slot < first + touched[i]; slot++) {
        for (var c = 0u; c < 3u; c++) {
            s[c] += sums[3u * slot + c];
        }
    }
    let fa = footprints[3u * i];
    let fb = footprints[3u * i + 1u];
    let fc = footprints[3u * i + 2u];
    // Sums of blending to the gradient of the footprint.
    let qa = fa.z;
    let qb = fa.w;
    let qc = fb.x;
    let sx = s[0].y * LN_2;
    let sy = s[0].z * LN_2;
    let v_xy = vec2f(-(2.0 * qa * sx + qb * sy), -(qb * sx + 2.0 * qc * sy));
    let v_conic = vec3f(-0.5 * s[0].w, -s[1].x, -0.5 * s[1].y);
    let v_opacity = s[0].x * exp2(-fb.y);
    let v_depth = s[2].y;
    var gathered = vec2f(s[2].z, s[2].w);
    if has(view.flags.x, FLAG_GATHER_ABSOLUTE) {
        gathered *= LN_2;
    }

    let g = load_geometry(i);
    let at = intermediate(g, load_variance(i));
    let inv_det = 1.0 / at.det_dilated;
    let a = at.cov_dilated.x;
    let b = at.cov_dilated.y;
    let c = at.cov_dilated.z;

    // conic = cov^-1: v_cov = -conic v_conic conic, with b counted twice.
    let q = vec3f(c, -b, a) * inv_det;
    let gb = 0.5 * v_conic.y;
    let left = vec4f(
        q.x * v_conic.x + q.y * gb,
        q.x * gb + q.y * v_conic.z,
        q.y * v_conic.x + q.z * gb,
        q.y * gb + q.z * v_conic.z,
    );
    var v_cov = vec3f(
        -(left.x * q.x + left.y * q.y),
        -2.0 * (left.x * q.y + left.y * q.z),
        -(left.z * q.y + left.w * q.z),
    );

    // Opacity, with its compensation sqrt(det / det_dilated).
    let own_opacity = at.sigmoid * at.thinning;
    var v_own_opacity = v_opacity;
    if has(view.flags.x, FLAG_ANTIALIAS) {
        let ratio = at.det * inv_det;
        let compensation = sqrt(max(ratio, COMPENSATION_FLOOR));
        var v_ratio = 0.0;
        if COMPENSATION_FLOOR < ratio {
            v_ratio = v_opacity * own_opacity * 0.5 / compensation;
        }
        let v_det = v_ratio * inv_det;
        let v_det_dilated = -v_det * ratio;
        v_cov.x += v_det * at.cov.z + v_det_dilated * c;
        v_cov.z += v_det * at.cov.x + v_det_dilated * a;
        v_cov.y -= 2.0 * b * (v_det + v_det_dilated);
        v_own_opacity = v_opacity * compensation;
    }

    // cov = V V^T, V = U diag(s), U = (J R) Rot.
    let v_v0 = 2.0 * v_cov.x * at.v[0] + v_cov.y * at.v[1];
    let v_v1 = 2.0 * v_cov.z * at.v[1] + v_cov.y * at.v[0];
    let v_log_filtered = v_v0 * at.v[0] + v_v1 * at.v[1];
    let v_log_thinning = v_own_opacity * own_opacity;
    var v_log_scale = v_log_filtered;
    if has(view.flags.x, FLAG_FILTER) {
        v_log_scale = v_log_filtered * at.fraction + v_log_thinning * (1.0 - at.fraction);
    }
    var v_u: array<vec3f, 2>;
    v_u[0] = v_v0 * at.scale;
    v_u[1] = v_v1 * at.scale;
    // Rows.
    var m: array<vec3f, 3>;
    m[0] = at.jr[0].x * v_u[0] + at.jr[1].x * v_u[1];
    m[1] = at.jr[0].y * v_u[0] + at.jr[1].y * v_u[1];
    m[2] = at.jr[0].z * v_u[0] + at.jr[1].z * v_u[1];

    // J R: row r is f_r / z (R_r - tangent_r R_2).
    var v_x = vec3f(0.0);
    var v_r: array<vec3f, 3>;
    v_r[2] = vec3f(0.0);
    for (var r = 0; r < 2; r++) {
        let v_jr = vec3f(dot(v_u[r], at.rot[0]), dot(v_u[r], at.rot[1]), dot(v_u[r], at.rot[2]));
        let j_scale = view.lens[r] * at.inv_z;
        v_r[r] = j_scale * v_jr;
        v_r[2] -= at.tangent[r] * v_r[r];
        let along_axis = dot(v_jr, view.rows[2].xyz);
        let v_j_scale = dot(v_jr, view.rows[r].xyz) - at.tangent[r] * along_axis;
        v_x.z -= v_j_scale * j_scale * at.inv_z;
        let tangent = at.x[r] * at.inv_z;
        var v_tangent = -j_scale * along_axis;
        if !(view.limits[2 * r] < tangent && tangent < view.limits[2 * r + 1]) {
            v_tangent = 0.0;
        }
        // The pixel position moves with the tangent, too, unclamped.
        let v_free = v_tangent + v_xy[r] * view.lens[r];
        v_x[r] += v_free * at.inv_z;
        v_x.z -= v_free * tangent * at.inv_z;
    }
    v_x.z += v_depth;
    var v_mean = v_x.x * view.rows[0].xyz + v_x.y * view.rows[1].xyz + v_x.z * view.rows[2].xyz;
    for (var r = 0; r < 3; r++) {
        v_r[r] += v_x[r] * g.mean;
    }

    // Rot(q), then the normalisation of q.
    let w = at.q.x;
    let x = at.q.y;
    let y = at.q.z;
    let z = at.q.w;
    let v_q = 2.0 * vec4f(
        z * (m[1].x - m[0].y) + y * (m[0].z - m[2].x) + x * (m[2].y - m[1].z),
        y * (m[0].y + m[1].x) + z * (m[0].z + m[2].x) + w * (m[2].y - m[1].z) - 2.0 * x * (m[1].y + m[2].z),
        x * (m[0].y + m[1].x) + z * (m[1].z + m[2].y) + w * (m[0].z - m[2].x) - 2.0 * y * (m[0].x + m[2].z),
        x * (m[0].z + m[2].x) + y * (m[1].z + m[2].y) + w * (m[1].x - m[0].y) - 2.0 * z * (m[0].x + m[1].y),
    );
    let v_quat = (v_q - at.q * dot(v_q, at.q)) * at.inv_q_norm;
    let v_logit = v_log_thinning * (1.0 - at.sigmoid);

    // Colours not above 0 were clamped.
    let shown = vec3f(fb.z, fb.w, fc.x);
    let v_color = select(vec3f(0.0), vec3f(s[1].z, s[1].w, s[2].x), shown > vec3f(0.0));
    let stride = view.splats.y;
    let degree = view.splats.z;
    var v_center = vec3f(0.0);
    if degree > 0u {
        var v_basis: array<f32, 16>;
        v_basis[0] = 0.0;
        let coefficients = (degree + 1u) * (degree + 1u);
        for (var k = 1u; k < 16u; k++) {
            v_basis[k] = 0.0;
            if k < coefficients {
                let plane = 3u * k * stride + i;
                v_basis[k] = dot(v_color, vec3f(harmonics[plane], harmonics[plane + stride], harmonics[plane + 2u * stride]));
            }
        }
        let d = direction(g.mean);
        let v_d = basis_vjp(degree, d.xyz, &v_basis);
        let v_by_color = (v_d - d.xyz * dot(d.xyz, v_d)) * d.w;
        v_mean += v_by_color;
        v_center = -v_by_color;
    }

    let magnitude = abs(v_logit) + dot(abs(v_color), vec3f(1.0)) + dot(abs(v_mean), vec3f(1.0)) + dot(abs(v_quat), vec4f(1.0))
        + dot(abs(v_log_scale), vec3f(1.0));
    let counts = is_finite(magnitude);
    if !counts {
        visible[i] = 0u;
        atomicAdd(&found[2], 1u);
    }
    var planes = array<f32, 18>(
        v_mean.x, v_mean.y, v_mean.z, v_quat.x, v_quat.y, v_quat.z, v_quat.w,
        v_log_scale.x, v_log_scale.y, v_log_scale.z, v_logit, v_color.x, v_color.y, v_color.z,
        v_xy.x, v_xy.y, gathered.x, gathered.y,
    );
    for (var plane = 0u; plane < 18u; plane++) {
        v_splats[plane * stride + i] = planes[plane];
    }
    if has(view.flags.x, FLAG_CAMERA) {
        let count = view.found.x;
        for (var r = 0u; r < 3u; r++) {
            for (var k = 0u; k < 3u; k++) {
                v_camera[(3u * r + k) * count + j] = select(0.0, v_r[r][k], counts);
            }
            v_camera[(9u + r) * count + j] = select(0.0, v_x[r], counts);
            v_camera[(12u + r) * count + j] = select(0.0, v_center[r], counts && is_finite(v_center[r]));
        }
    }
}
