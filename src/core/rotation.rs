//! Rotations as quaternions `x y z w`, from and to the forms in which samples and networks have them.
//!
//! Invariant: pure: nothing here allocates, and no input causes a panic.

/// A quaternion `x y z w`. A rotation has the length 1; `q` and `-q` are the same one.
pub type Quaternion = [f64; 4];

/// The rotation by nothing.
pub const NONE: Quaternion = [0.0, 0.0, 0.0, 1.0];

/// Rows of a matrix closer to parallel than this, and shorter ones, give no rotation: 32-bit numbers of a network have
/// errors of 1e-7, which then no longer decide the direction.
const SMALLEST: f64 = 1e-4;

/// Of length 1. `None` if it has no length, or one that is not finite.
pub fn normalized(q: Quaternion) -> Option<Quaternion> {
    let length = q.iter().map(|part| part * part).sum::<f64>().sqrt();
    (length.is_finite() && length > 0.0).then(|| q.map(|part| part / length))
}

/// The rotation by `b`, then by `a`: the product of their matrices in this order.
pub fn product(a: Quaternion, b: Quaternion) -> Quaternion {
    let ([ax, ay, az, aw], [bx, by, bz, bw]) = (a, b);
    [
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    ]
}

/// The matrix of a rotation of length 1, by rows.
pub fn matrix([x, y, z, w]: Quaternion) -> [[f64; 3]; 3] {
    [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
        [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
        [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
    ]
}

/// A vector turned by a rotation of length 1.
pub fn turned(q: Quaternion, vector: [f64; 3]) -> [f64; 3] {
    matrix(q).map(|row| dot(row, vector))
}

/// The first two rows of its matrix, the form `rotation_6d` (Zhou et al. 2019) as UMI has it.
pub fn rows(q: Quaternion) -> [[f64; 3]; 2] {
    let [first, second, _] = matrix(q);
    [first, second]
}

/// The inverse of [`rows`] for numbers of a network: the first row keeps its direction, the second is made
/// perpendicular to it. `None` if a row is zero or not finite, or both are parallel: these numbers are not a rotation.
pub fn of_rows([first, second]: [[f64; 3]; 2]) -> Option<Quaternion> {
    let unit = |row: [f64; 3]| {
        let length = dot(row, row).sqrt();
        (length.is_finite() && length > SMALLEST).then(|| row.map(|part| part / length))
    };
    let (first, second) = (unit(first)?, unit(second)?);
    let along = dot(first, second);
    let second = unit([0, 1, 2].map(|at| second[at] - along * first[at]))?;
    let third = [
        first[1] * second[2] - first[2] * second[1],
        first[2] * second[0] - first[0] * second[2],
        first[0] * second[1] - first[1] * second[0],
    ];
    normalized(of_matrix([first, second, third]))
}

/// The four numbers that a network gives for a quaternion, of length 1. `None` if they are zero or not finite.
pub fn of_four(q: Quaternion) -> Option<Quaternion> {
    let length = q.iter().map(|part| part * part).sum::<f64>().sqrt();
    (length > SMALLEST).then_some(q).and_then(normalized)
}

/// The quaternion of a rotation's matrix, given by rows, of any length. The largest of the four parts is found first,
/// because the others are divided by it (Shepperd, 1978).
pub fn of_matrix([[xx, xy, xz], [yx, yy, yz], [zx, zy, zz]]: [[f64; 3]; 3]) -> Quaternion {
    let trace = xx + yy + zz;
    if trace >= xx && trace >= yy && trace >= zz {
        [zy - yz, xz - zx, yx - xy, 1.0 + trace]
    } else if xx >= yy && xx >= zz {
        [1.0 + xx - yy - zz, yx + xy, xz + zx, zy - yz]
    } else if yy >= zz {
        [yx + xy, 1.0 - xx + yy - zz, zy + yz, xz - zx]
    } else {
        [xz + zx, zy + yz, 1.0 - xx - yy + zz, yx - xy]
    }
}

/// Of the two quaternions of the rotation `q` the one nearer to `to`.
pub fn nearer(q: Quaternion, to: Quaternion) -> Quaternion {
    let along: f64 = q.iter().zip(to).map(|(one, other)| one * other).sum();
    if along < 0.0 { q.map(|part| -part) } else { q }
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a.iter().zip(b).map(|(one, other)| one * other).sum()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn close(found: &[f64], expected: &[f64]) -> bool {
        found.len() == expected.len() && found.iter().zip(expected).all(|(one, other)| (one - other).abs() < 1e-9)
    }

    fn rotation() -> impl Strategy<Value = Quaternion> {
        prop::array::uniform4(-1.0..1.0)
            .prop_filter_map("of a length", |q| normalized(q).filter(|_| q.iter().any(|part: &f64| part.abs() > 0.01)))
    }

    #[test]
    fn a_quarter_turn_about_z_makes_x_to_y() {
        let half = 0.5_f64.sqrt();
        let quarter = [0.0, 0.0, half, half];
        assert!(close(&turned(quarter, [1.0, 0.0, 0.0]), &[0.0, 1.0, 0.0]));
        assert_eq!(rows(quarter).map(|row| row.map(f64::round)), [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0]]);
        assert!(close(&product(quarter, quarter), &[0.0, 0.0, 1.0, 0.0]));
    }

    #[test]
    fn what_is_no_rotation_gives_none() {
        let x = [1.0, 0.0, 0.0];
        assert_eq!(of_rows([x, [0.0, 2.0, 0.0]]), Some(NONE), "of any length");
        let slanted = of_rows([x, [1.0, 1.0, 0.0]]).expect("a rotation");
        assert!(close(&slanted, &NONE), "the second row is made perpendicular to the first: {slanted:?}");
        for (one, other) in [
            (x, [0.0; 3]),
            ([0.0; 3], x),
            (x, x),
            (x, [-3.0, 0.0, 0.0]),
            (x, [1.0, 1e-7, 0.0]),
            (x, [0.0, f64::NAN, 0.0]),
            ([f64::INFINITY, 0.0, 0.0], x),
        ] {
            assert_eq!(of_rows([one, other]), None, "{one:?} {other:?}");
        }
        assert_eq!((of_four([0.0, 0.0, 0.0, 2.0]), of_four([1e-6; 4])), (Some(NONE), None));
        for q in [[0.0; 4], [f64::NAN, 0.0, 0.0, 1.0], [f64::MAX, f64::MAX, 0.0, 0.0]] {
            assert_eq!((normalized(q), of_four(q)), (None, None), "{q:?}");
        }
    }

    proptest! {
        #[test]
        fn the_forms_of_a_rotation_are_one(a in rotation(), b in rotation(), v in prop::array::uniform3(-2.0..2.0)) {
            let (one, other) = (turned(product(a, b), v), turned(a, turned(b, v)));
            prop_assert!(close(&one, &other), "{one:?} {other:?}");
            for again in [of_rows(rows(a)), of_rows(rows(a).map(|row| row.map(|part| 3.0 * part))), normalized(of_matrix(matrix(a)))] {
                let again = nearer(again.expect("a rotation"), a);
                prop_assert!(close(&again, &a), "{again:?} {a:?}");
            }
        }
    }
}
