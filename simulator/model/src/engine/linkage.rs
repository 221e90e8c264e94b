// SPDX-License-Identifier: GPL-3.0-or-later
//! The geometry of kinematics that are not a gantry: where the nozzle is while the rails are at these places.
//!
//! Places are the rails' in klippy's order of axes. The sketches are the same as in `klippy/kinematics/*.py`.

use crate::description::axes::DeltaConfig;
use crate::description::kinematics::{RotaryDeltaConfig, WinchConfig};
use crate::description::printer::Kinematics;

/// Highest number of rails.
pub(crate) const RAILS_MAX: usize = WinchConfig::CABLES.len();

/// A kinematics.
#[derive(Clone, Debug)]
pub(crate) enum Linkage {
    /// Three towers: where they stand, and their arms.
    Delta { towers_mm: [[f64; 2]; 3], arms_mm: [f64; 3] },
    /// Two towers and a bed.
    Deltesian { arms_mm: [f64; 2], arm_x_mm: [f64; 2] },
    /// A bed that turns, an arm, and z.
    Polar,
    /// Three arms that turn.
    RotaryDelta(RotaryDeltaConfig),
    /// Cables from these anchors.
    Winch { anchors_mm: Vec<[f64; 3]> },
}

impl From<&DeltaConfig> for Linkage {
    fn from(config: &DeltaConfig) -> Linkage {
        Linkage::Delta { towers_mm: config.towers_mm(), arms_mm: config.arms_mm() }
    }
}

impl Kinematics<'_> {
    /// The geometry of a kinematics without a gantry.
    pub(crate) fn linkage(&self) -> Option<Linkage> {
        Some(match *self {
            Kinematics::Delta(delta) => delta.into(),
            Kinematics::Deltesian(config) => Linkage::Deltesian { arms_mm: config.arms_mm, arm_x_mm: config.arm_x_mm },
            Kinematics::Polar => Linkage::Polar,
            Kinematics::RotaryDelta(rotary) => Linkage::RotaryDelta(rotary.clone()),
            Kinematics::Winch(winch) => Linkage::Winch { anchors_mm: winch.anchors_mm.clone() },
            _ => return None,
        })
    }
}

impl Linkage {
    /// The nozzle's place.
    pub(crate) fn nozzle_mm(&self, places: &[f64; RAILS_MAX]) -> [f64; 3] {
        match self {
            Linkage::Delta { towers_mm, arms_mm } => {
                let joints = [0, 1, 2].map(|tower| [towers_mm[tower][0], towers_mm[tower][1], places[tower]]);
                joined(joints, *arms_mm)[0]
            }
            Linkage::Deltesian { arms_mm, arm_x_mm } => {
                let [left, right, y, ..] = *places;
                // From one carriage to the other, and from there down to the head.
                let (dx, dz) = (arm_x_mm[0] + arm_x_mm[1], right - left);
                let apart = dx.hypot(dz);
                let along = (apart * apart + arms_mm[0].powi(2) - arms_mm[1].powi(2)) / (2.0 * apart);
                let down = (arms_mm[0].powi(2) - along * along).max(0.0).sqrt();
                let x = -arm_x_mm[0] + (along * dx + down * dz) / apart;
                [x, y, left + (along * dz - down * dx) / apart]
            }
            Linkage::Polar => {
                let [bed, arm, z, ..] = *places;
                [arm * bed.cos(), arm * bed.sin(), z]
            }
            Linkage::RotaryDelta(config) => {
                joined([0, 1, 2].map(|arm| elbow_mm(config, arm, places[arm])), config.lower_arms_mm)[0]
            }
            Linkage::Winch { anchors_mm } => {
                let Some(&[a, b, c]) = anchors_mm.first_chunk() else { return [0.0; 3] };
                let both = joined([a, b, c], [places[0], places[1], places[2]]);
                // The other cables say on which side of the first three the head is. Without them it is above.
                let off = |at: &[f64; 3]| {
                    let cables = anchors_mm.iter().zip(places).skip(3);
                    cables.map(|(anchor, length)| (distance_mm(*anchor, *at) - length).abs()).sum::<f64>()
                };
                let [below, above] = both;
                if off(&below) < off(&above) { below } else { above }
            }
        }
    }

    /// The way of the nozzle for a step of a rail: at most this much for each millimeter or radian.
    pub(crate) fn leverage_mm(&self, rail: usize, reach_mm: f64) -> f64 {
        match self {
            Linkage::Polar if rail == 0 => reach_mm,
            Linkage::RotaryDelta(config) => config.upper_arms_mm[rail.min(2)] + config.lower_arms_mm[rail.min(2)],
            _ => 1.0,
        }
    }
}

fn distance_mm(a: [f64; 3], b: [f64; 3]) -> f64 {
    (0..3).map(|i| (a[i] - b[i]).powi(2)).sum::<f64>().sqrt()
}

/// The end of an upper arm.
fn elbow_mm(config: &RotaryDeltaConfig, arm: usize, angle: f64) -> [f64; 3] {
    let (sine, cosine) = config.angles_degrees[arm].to_radians().sin_cos();
    let out = config.shoulder_radius_mm + config.upper_arms_mm[arm] * angle.cos();
    [out * cosine, out * sine, config.shoulder_height_mm + config.upper_arms_mm[arm] * angle.sin()]
}

/// The two places at these distances from three joints: the one below first. Arms that cannot join count as stretched.
fn joined(joints: [[f64; 3]; 3], arms_mm: [f64; 3]) -> [[f64; 3]; 2] {
    let [a, b, c] = joints;
    let minus = |p: [f64; 3], q: [f64; 3]| [0, 1, 2].map(|i| p[i] - q[i]);
    let dot = |p: [f64; 3], q: [f64; 3]| (0..3).map(|i| p[i] * q[i]).sum::<f64>();
    let length = |p: [f64; 3]| dot(p, p).sqrt();
    // A frame in the plane of the joints.
    let (to_b, to_c) = (minus(b, a), minus(c, a));
    let d = length(to_b).max(f64::MIN_POSITIVE);
    let ex = to_b.map(|value| value / d);
    let i = dot(ex, to_c);
    let across = [0, 1, 2].map(|n| to_c[n] - i * ex[n]);
    let j = length(across).max(f64::MIN_POSITIVE);
    let ey = across.map(|value| value / j);
    let ez = [ex[1] * ey[2] - ex[2] * ey[1], ex[2] * ey[0] - ex[0] * ey[2], ex[0] * ey[1] - ex[1] * ey[0]];
    let [ra, rb, rc] = arms_mm.map(|mm| mm * mm);
    let x = (ra - rb + d * d) / (2.0 * d);
    let y = (ra - rc + i * i + j * j) / (2.0 * j) - i / j * x;
    let z = (ra - x * x - y * y).max(0.0).sqrt();
    let at = |z: f64| [0, 1, 2].map(|n| a[n] + x * ex[n] + y * ey[n] + z * ez[n]);
    if ez[2] > 0.0 { [at(-z), at(z)] } else { [at(z), at(-z)] }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::f64::consts::PI;

    /// The places of the rails with the nozzle there. Not a number if it cannot be there.
    fn places(linkage: &Linkage, nozzle_mm: [f64; 3]) -> [f64; RAILS_MAX] {
        let [x, y, z] = nozzle_mm;
        let mut places = [0.0; RAILS_MAX];
        match linkage {
            Linkage::Delta { towers_mm, arms_mm } => {
                for tower in 0..3 {
                    let [tower_x, tower_y] = towers_mm[tower];
                    let square = arms_mm[tower].powi(2) - (x - tower_x).powi(2) - (y - tower_y).powi(2);
                    places[tower] = z + square.sqrt();
                }
            }
            Linkage::Deltesian { arms_mm, arm_x_mm } => {
                places[0] = z + (arms_mm[0].powi(2) - (x + arm_x_mm[0]).powi(2)).sqrt();
                places[1] = z + (arms_mm[1].powi(2) - (x - arm_x_mm[1]).powi(2)).sqrt();
                places[2] = y;
            }
            Linkage::Polar => places[..3].copy_from_slice(&[y.atan2(x), x.hypot(y), z]),
            Linkage::RotaryDelta(config) => {
                for (arm, place) in places[..3].iter_mut().enumerate() {
                    *place = shoulder_angle(config, arm, nozzle_mm);
                }
            }
            Linkage::Winch { anchors_mm } => {
                places.iter_mut().zip(anchors_mm).for_each(|(place, anchor)| *place = distance_mm(*anchor, nozzle_mm));
            }
        }
        places
    }

    /// The angle of an upper arm whose elbow is one lower arm from the nozzle. The elbow points outward.
    fn shoulder_angle(config: &RotaryDeltaConfig, arm: usize, [x, y, z]: [f64; 3]) -> f64 {
        let (sine, cosine) = config.angles_degrees[arm].to_radians().sin_cos();
        let aside = y * cosine - x * sine;
        let (dx, dy) = (x * cosine + y * sine - config.shoulder_radius_mm, z - config.shoulder_height_mm);
        let (upper, lower) = (config.upper_arms_mm[arm], (config.lower_arms_mm[arm].powi(2) - aside * aside).sqrt());
        // The triangle of shoulder, elbow and joint.
        let reach = dx.hypot(dy);
        let between = ((upper * upper + reach * reach - lower * lower) / (2.0 * upper * reach)).acos();
        let to_joint = dy.atan2(dx);
        let angle = to_joint + between;
        // The joint is below the shoulder and inside of it. Counted this way around, the elbow is outside.
        if angle > PI { angle - 2.0 * PI } else { angle }
    }

    fn assert_there_and_back(linkage: &Linkage, nozzle_mm: [f64; 3]) -> Result<(), TestCaseError> {
        let back = linkage.nozzle_mm(&places(linkage, nozzle_mm));
        for i in 0..3 {
            prop_assert!((back[i] - nozzle_mm[i]).abs() < 1e-6, "{linkage:?}: {nozzle_mm:?} {back:?}");
        }
        Ok(())
    }

    fn rotary() -> RotaryDeltaConfig {
        RotaryDeltaConfig {
            shoulder_radius_mm: 33.9,
            shoulder_height_mm: 412.9,
            upper_arms_mm: [170.0; 3],
            lower_arms_mm: [320.0, 321.0, 319.0],
            angles_degrees: [30.0, 150.5, 270.0],
            bed_radius_mm: 100.0,
        }
    }

    proptest! {
        #[test]
        fn the_rails_places_give_the_nozzle_back(r in 0.0f64..80.0, angle in -3.1f64..3.1, z in 0.0f64..150.0) {
            let nozzle_mm = [r * angle.cos(), r * angle.sin(), z];
            let delta = DeltaConfig {
                radius_mm: 105.0, arm_mm: 215.0, arms_mm: Some([215.0, 216.0, 214.0]), bed_radius_mm: 90.0,
                angles_degrees: [210.0, 331.0, 90.0],
            };
            assert_there_and_back(&Linkage::from(&delta), nozzle_mm)?;
            let deltesian = Linkage::Deltesian { arms_mm: [217.0, 218.0], arm_x_mm: [120.0, 121.0] };
            assert_there_and_back(&deltesian, nozzle_mm)?;
            assert_there_and_back(&Linkage::Polar, nozzle_mm)?;
            assert_there_and_back(&Linkage::RotaryDelta(rotary()), nozzle_mm)?;
            let low = [[0.0, -2000.0, -100.0], [2000.0, 1000.0, -100.0], [-2000.0, 1000.0, -100.0], [0.0, 0.0, 3000.0]];
            assert_there_and_back(&Linkage::Winch { anchors_mm: low.to_vec() }, nozzle_mm)?;
            assert_there_and_back(&Linkage::Winch { anchors_mm: low[..3].to_vec() }, nozzle_mm)?;
        }
    }

    /// klippy's own values (`RotaryDeltaCalibration.calc_stepper_position` by its formula in kin_rotary_delta.c).
    #[test]
    fn a_rotary_delta_counts_its_angles_as_klippy_does() {
        let config = rotary();
        let linkage = Linkage::RotaryDelta(config.clone());
        let klippy = |[x, y, z]: [f64; 3], arm: usize| {
            let (sin, cos) = config.angles_degrees[arm].to_radians().sin_cos();
            let sjz = y * cos - x * sin;
            let (dx, dy) = (x * cos + y * sin - config.shoulder_radius_mm, z - config.shoulder_height_mm);
            let (upper2, lower2) = (config.upper_arms_mm[arm].powi(2), config.lower_arms_mm[arm].powi(2) - sjz * sjz);
            let c1 = 0.5 / dy * (dx * dx + dy * dy + upper2 - lower2);
            let c2 = dx / dy;
            let scale = c2 * c2 + 1.0;
            let ex = c1 * c2 + (scale * upper2 - c1 * c1).sqrt();
            (c1 * scale - c2 * ex).atan2(ex)
        };
        for nozzle_mm in [[0.0, 0.0, 0.0], [40.0, -30.0, 10.0], [-60.0, 50.0, 120.0]] {
            for arm in 0..3 {
                let (ours, its) = (places(&linkage, nozzle_mm)[arm], klippy(nozzle_mm, arm));
                assert!((ours - its).abs() < 1e-9, "{nozzle_mm:?} {arm}: {ours} {its}");
            }
        }
    }
}
