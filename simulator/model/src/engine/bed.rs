// SPDX-License-Identifier: GPL-3.0-or-later
//! The bed, and the position of the head over it.
//!
//! Motors hold a cartesian printer's gantry, or its bed, each at its own place. A delta's nozzle hangs on three
//! carriages. In both cases the distance to the bed follows from the positions of the motors.

use std::sync::Arc;

use super::linkage::{Linkage, RAILS_MAX};
use super::rail::Rail;
use crate::description::axes::BedConfig;

/// A plane that motors hold up, each at a place: a gantry over the bed, or the bed under it.
///
/// The plane is stiff. Three motors define it. Two leave it level across their line, and one leaves it level. More than
/// three pull at it like springs. It then settles as near to all of them as possible (least squares).
pub struct Plane {
    /// The middle of the motors.
    middle: [f64; 2],
    /// The motors, and how much each one tilts the plane along x and y: per millimeter of the motor's position.
    motors: Vec<(Arc<Rail>, [f64; 2])>,
}

impl Plane {
    /// The plane that these motors hold at these places.
    pub fn new(motors: Vec<(Arc<Rail>, [f64; 2])>) -> Plane {
        let count = motors.len().max(1) as f64;
        let sum = |term: &dyn Fn(&[f64; 2]) -> f64| motors.iter().map(|(_, at)| term(at)).sum::<f64>();
        let middle = [sum(&|at| at[0]) / count, sum(&|at| at[1]) / count];
        let [mx, my] = middle;
        let xx = sum(&|at| (at[0] - mx).powi(2));
        let xy = sum(&|at| (at[0] - mx) * (at[1] - my));
        let yy = sum(&|at| (at[1] - my).powi(2));
        // The inverse of [[xx, xy], [xy, yy]]; the pseudo-inverse if the motors stand in a line.
        let (trace, determinant) = (xx + yy, xx * yy - xy * xy);
        let [ixx, ixy, iyy] = if trace == 0.0 {
            [0.0; 3]
        } else if determinant > 1e-9 * trace * trace {
            [yy / determinant, -xy / determinant, xx / determinant]
        } else {
            [xx, xy, yy].map(|term| term / (trace * trace))
        };
        let tilt = |[x, y]: [f64; 2]| {
            let (x, y) = (x - mx, y - my);
            [ixx * x + ixy * y, ixy * x + iyy * y]
        };
        Plane { middle, motors: motors.into_iter().map(|(axis, at)| (axis, tilt(at))).collect() }
    }

    /// The height of the plane at a place, while the motors are at these positions.
    fn height_mm(&self, [x_mm, y_mm]: [f64; 2], position_mm: impl Fn(&Rail) -> f64) -> f64 {
        let mean = 1.0 / self.motors.len().max(1) as f64;
        let (x_mm, y_mm) = (x_mm - self.middle[0], y_mm - self.middle[1]);
        self.motors.iter().map(|(axis, [x, y])| position_mm(axis) * (mean + x * x_mm + y * y_mm)).sum()
    }
}

/// A head that hangs on a linkage. It stays upright.
pub struct Hanging {
    linkage: Linkage,
    /// In the linkage's order.
    rails: Vec<Arc<Rail>>,
    bed: BedShape,
}

impl Hanging {
    pub fn new(linkage: Linkage, rails: Vec<Arc<Rail>>, bed: BedShape) -> Hanging {
        Hanging { linkage, rails, bed }
    }

    fn nozzle_mm(&self, position_mm: impl Fn(&Rail) -> f64) -> [f64; 3] {
        let mut places = [0.0; RAILS_MAX];
        places.iter_mut().zip(&self.rails).for_each(|(place, rail)| *place = position_mm(rail));
        self.linkage.nozzle_mm(&places)
    }
}

/// The kinematics that hold the nozzle over the bed.
pub enum Head {
    /// Rails along x and y, and those of the z axis.
    Cartesian { x: Option<Arc<Rail>>, y: Option<Arc<Rail>>, z: Plane },
    /// Arms, cables, or a bed that turns.
    Hanging(Hanging),
}

impl Head {
    /// The position of a point at this offset from the nozzle, while the rails are at these positions.
    fn point_mm(
        &self,
        [x_offset_mm, y_offset_mm, z_offset_mm]: [f64; 3],
        position_mm: impl Fn(&Rail) -> f64,
    ) -> [f64; 3] {
        match self {
            Head::Cartesian { x, y, z } => {
                let position = |rail: &Option<Arc<Rail>>| rail.as_ref().map_or(0.0, |rail| position_mm(rail));
                let (x_mm, y_mm) = (position(x) + x_offset_mm, position(y) + y_offset_mm);
                // The head is tilted like the gantry. If the motors hold the bed, the bed is tilted instead.
                [x_mm, y_mm, z.height_mm([x_mm, y_mm], &position_mm) + z_offset_mm]
            }
            Head::Hanging(hanging) => {
                let [x_mm, y_mm, z_mm] = hanging.nozzle_mm(position_mm);
                [x_mm + x_offset_mm, y_mm + y_offset_mm, z_mm + z_offset_mm]
            }
        }
    }

    /// The nozzle's place, while the rails are at these positions.
    pub(crate) fn nozzle_mm(&self, position_mm: impl Fn(&Rail) -> f64) -> [f64; 3] {
        self.point_mm([0.0; 3], position_mm)
    }

    /// The rails that move the nozzle.
    pub(crate) fn rails(&self) -> Vec<&Arc<Rail>> {
        match self {
            Head::Cartesian { x, y, z } => x.iter().chain(y).chain(z.motors.iter().map(|(rail, _)| rail)).collect(),
            Head::Hanging(hanging) => hanging.rails.iter().collect(),
        }
    }

    /// The greatest way of the nozzle in a step.
    pub(crate) fn step_mm(&self) -> f64 {
        let steps_mm = |leverage_mm: &dyn Fn(usize) -> f64| {
            let rails = self.rails().into_iter().enumerate();
            rails.map(|(n, rail)| rail.step_mm() * leverage_mm(n)).fold(0.0, f64::max)
        };
        match self {
            Head::Cartesian { .. } => steps_mm(&|_| 1.0),
            Head::Hanging(hanging) => steps_mm(&|rail| hanging.linkage.leverage_mm(rail, hanging.bed.reach_mm())),
        }
    }

    /// The space that the nozzle can reach; `None` if it has no end.
    pub(crate) fn space(&self) -> Option<Space> {
        let travel = |rail: &Arc<Rail>| rail.travel_mm;
        match self {
            Head::Cartesian { x, y, z } => {
                let (x, y) = (x.as_ref().and_then(travel)?, y.as_ref().and_then(travel)?);
                let heights = z.motors.iter().filter_map(|(rail, _)| travel(rail).map(|(_, max_mm)| max_mm));
                Some(Space {
                    bed: BedShape::Rectangle { min_mm: [x.0, y.0], max_mm: [x.1, y.1] },
                    height_mm: heights.reduce(f64::min)?,
                })
            }
            Head::Hanging(Hanging { linkage: Linkage::Winch { anchors_mm }, bed, .. }) => {
                let height_mm = anchors_mm.iter().map(|anchor| anchor[2]).fold(0.0, f64::max);
                Some(Space { bed: *bed, height_mm })
            }
            Head::Hanging(hanging) => {
                let highest = |rail: &Rail| rail.travel_mm.map_or(0.0, |(_, max_mm)| max_mm);
                Some(Space { bed: hanging.bed, height_mm: hanging.nozzle_mm(highest)[2] })
            }
        }
    }

    /// The ends of the bed along x and y; `None` if nothing moves along that direction.
    fn ends_mm(&self) -> [Option<(f64, f64)>; 2] {
        match self {
            Head::Cartesian { x, y, .. } => [x, y].map(|rail| rail.as_ref().and_then(|rail| rail.travel_mm)),
            Head::Hanging(hanging) => match hanging.bed {
                BedShape::Rectangle { min_mm, max_mm } => [0, 1].map(|n| Some((min_mm[n], max_mm[n]))),
                BedShape::Disc { radius_mm } => [Some((-radius_mm, radius_mm)); 2],
            },
        }
    }
}

/// The outline of the bed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum BedShape {
    /// From one corner to the opposite one: x and y. The travels of the axes are its sides.
    Rectangle {
        /// The corner in front, on the left.
        min_mm: [f64; 2],
        /// The corner behind, on the right.
        max_mm: [f64; 2],
    },
    /// A delta's bed. Its middle is at 0.
    Disc {
        /// From the middle to the edge.
        radius_mm: f64,
    },
}

impl BedShape {
    /// The farthest place from the middle of the coordinates.
    fn reach_mm(&self) -> f64 {
        match self {
            BedShape::Rectangle { min_mm, max_mm } => {
                [0, 1].map(|n| min_mm[n].abs().max(max_mm[n].abs())).into_iter().fold(0.0, f64::hypot)
            }
            BedShape::Disc { radius_mm } => *radius_mm,
        }
    }
}

/// The space that the nozzle can reach.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Space {
    /// The bed below it.
    pub bed: BedShape,
    /// How high it is above the bed. On a delta that is so in its middle.
    pub height_mm: f64,
}

/// The bed under the nozzle.
pub struct Bed {
    shape: BedConfig,
    ends_mm: [Option<(f64, f64)>; 2],
    head: Head,
}

impl Bed {
    pub fn new(shape: BedConfig, head: Head) -> Bed {
        let ends_mm = match (shape.min_mm, shape.max_mm) {
            (Some(min_mm), Some(max_mm)) => [0, 1].map(|n| Some((min_mm[n], max_mm[n]))),
            _ => head.ends_mm(),
        };
        Bed { shape, ends_mm, head }
    }

    /// The height of the bed at a place: two slopes and a bow, each 0 in the middle.
    pub fn height_mm(&self, x_mm: f64, y_mm: f64) -> f64 {
        // From -1 at one end of the bed to 1 at the other.
        let place = |ends_mm: Option<(f64, f64)>, mm: f64| match ends_mm {
            Some((start_mm, end_mm)) => (2.0 * (mm - start_mm) / (end_mm - start_mm) - 1.0).clamp(-1.0, 1.0),
            None => 0.0,
        };
        let (u, v) = (place(self.ends_mm[0], x_mm), place(self.ends_mm[1], y_mm));
        let slopes = (self.shape.x_slope_mm * u + self.shape.y_slope_mm * v) / 2.0;
        slopes - self.shape.bow_mm * (u * u + v * v) / 2.0
    }

    /// How far the point at this offset from the nozzle is above the bed; negative if it presses into the bed.
    pub fn clearance_mm(&self, offset_mm: [f64; 3]) -> f64 {
        let [x_mm, y_mm, z_mm] = self.head.point_mm(offset_mm, Rail::position_mm);
        z_mm - self.height_mm(x_mm, y_mm)
    }

    /// The space over it that the nozzle can reach; `None` if it has no end.
    pub(crate) fn space(&self) -> Option<Space> {
        let space = self.head.space()?;
        let bed = match (self.shape.min_mm, self.shape.max_mm) {
            (Some(min_mm), Some(max_mm)) => BedShape::Rectangle { min_mm, max_mm },
            _ => space.bed,
        };
        Some(Space { bed, ..space })
    }

    /// The kinematics over it.
    pub(crate) fn head(&self) -> &Head {
        &self.head
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::description::axes::{AxisConfig, DeltaConfig};
    use crate::engine::motion::Axis;
    use proptest::prelude::*;
    use std::f64::consts::TAU;

    /// An axis that stands at a place.
    fn axis_at(start_mm: f64) -> Arc<Rail> {
        let text = "name = \"z\"\nstep_pin = \"s\"\ndir_pin = \"d\"\nsteps_per_mm = 1000000.0\n";
        let mut config: AxisConfig = toml::from_str(text).unwrap();
        config.start_mm = start_mm;
        Axis::new(&config).rail().clone()
    }

    fn hanging(config: &DeltaConfig, carriages: [Arc<Rail>; 3]) -> Head {
        let bed = BedShape::Disc { radius_mm: config.bed_radius_mm };
        Head::Hanging(Hanging::new(config.into(), carriages.into(), bed))
    }

    fn plane(motors: &[([f64; 2], f64)]) -> Plane {
        Plane::new(motors.iter().map(|(at, mm)| (axis_at(*mm), *at)).collect())
    }

    fn assert_near(value: f64, expected: f64) {
        assert!((value - expected).abs() < 1e-5, "{value} {expected}");
    }

    #[test]
    fn one_motor_lifts_all_of_it_and_two_tilt_it_along_their_line() {
        let one = plane(&[([30.0, 40.0], 2.5)]);
        assert_near(one.height_mm([-500.0, 900.0], Rail::position_mm), 2.5);
        let two = plane(&[([0.0, 100.0], 1.0), ([200.0, 100.0], 3.0)]);
        for y_mm in [-50.0, 100.0, 220.0] {
            assert_near(two.height_mm([0.0, y_mm], Rail::position_mm), 1.0);
            assert_near(two.height_mm([50.0, y_mm], Rail::position_mm), 1.5);
            assert_near(two.height_mm([300.0, y_mm], Rail::position_mm), 4.0);
        }
        // Without places all motors stand at one place.
        let nowhere = plane(&[([0.0, 0.0], 1.0), ([0.0, 0.0], 3.0)]);
        assert_near(nowhere.height_mm([170.0, 20.0], Rail::position_mm), 2.0);
        assert_near(plane(&[]).height_mm([1.0, 1.0], Rail::position_mm), 0.0);
    }

    #[test]
    fn a_fourth_motor_that_disagrees_is_met_halfway() {
        let at = [[0.0, 0.0], [0.0, 200.0], [200.0, 200.0], [200.0, 0.0]];
        let twisted = plane(&[(at[0], 1.0), (at[1], 0.0), (at[2], 1.0), (at[3], 0.0)]);
        for [x_mm, y_mm] in at {
            assert_near(twisted.height_mm([x_mm, y_mm], Rail::position_mm), 0.5);
        }
    }

    proptest! {
        /// If three or four motors agree on a plane, the result is that plane.
        #[test]
        fn motors_that_agree_define_the_plane(
            level in -5.0..5.0, slopes in prop::array::uniform2(-0.02..0.02), four: bool,
            place in prop::array::uniform2(-300.0..300.0),
        ) {
            let height = |[x, y]: [f64; 2]| level + slopes[0] * x + slopes[1] * y;
            let at = [[-20.0, 10.0], [110.0, 260.0], [240.0, 15.0], [250.0, 280.0]];
            let motors: Vec<_> = at.iter().take(if four { 4 } else { 3 }).map(|at| (*at, height(*at))).collect();
            assert_near(plane(&motors).height_mm(place, Rail::position_mm), height(place));
        }

        /// The nozzle of a delta is where klippy's formula for its towers puts the carriages. Only places on the bed
        /// count. Farther out an arm lies flat. There the nozzle moves far when a carriage's position is rounded to a
        /// millionth of a millimeter.
        #[test]
        fn a_delta_is_where_its_carriages_put_it(
            away in 0.0..90.0f64, around in 0.0..TAU, z in -1.0..250.0f64, turn in -5.0..5.0f64,
        ) {
            let (x, y) = (away * around.cos(), away * around.sin());
            let config = DeltaConfig {
                radius_mm: 105.0,
                arm_mm: 215.0,
                arms_mm: None,
                bed_radius_mm: 90.0,
                angles_degrees: [210.0 + turn, 330.0, 90.0],
            };
            let carriage = |tower: usize| {
                let [tower_x, tower_y] = config.towers_mm()[tower];
                z + (215.0f64.powi(2) - (x - tower_x).powi(2) - (y - tower_y).powi(2)).sqrt()
            };
            let carriages = [0, 1, 2].map(|tower| axis_at(carriage(tower)));
            let head = hanging(&config, carriages);
            let point = head.point_mm([1.0, -2.0, -3.0], Rail::position_mm);
            for (value, expected) in point.into_iter().zip([x + 1.0, y - 2.0, z - 3.0]) {
                assert_near(value, expected);
            }
        }
    }

    #[test]
    fn the_bed_of_a_delta_has_its_middle_at_zero() {
        let config = DeltaConfig {
            radius_mm: 105.0,
            arm_mm: 215.0,
            arms_mm: None,
            bed_radius_mm: 90.0,
            angles_degrees: [210.0, 330.0, 90.0],
        };
        let carriages = [0, 1, 2].map(|_| axis_at(config.lowest_mm() + 7.0));
        let shape = BedConfig { x_slope_mm: 0.2, bow_mm: 0.1, ..BedConfig::default() };
        let bed = Bed::new(shape, hanging(&config, carriages));
        assert_near(bed.clearance_mm([0.0, 0.0, -2.0]), 5.0);
        assert_near(bed.height_mm(90.0, 0.0), 0.1 - 0.05);
        assert_near(bed.height_mm(-90.0, 0.0), -0.1 - 0.05);
    }

    #[test]
    fn a_probe_beside_the_nozzle_feels_the_tilt() {
        let (x, y) = (axis_at(50.0), axis_at(50.0));
        let z = plane(&[([0.0, 50.0], 1.0), ([100.0, 50.0], 2.0)]);
        let bed = Bed::new(BedConfig::default(), Head::Cartesian { x: Some(x), y: Some(y), z });
        assert_near(bed.clearance_mm([0.0; 3]), 1.5);
        assert_near(bed.clearance_mm([20.0, 5.0, -0.5]), 1.2);
    }
}
