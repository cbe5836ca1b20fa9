//! The pictures of the task's cameras: 96 x 96 pixels, 8-bit RGB.
//!
//! The wrist camera looks down between the fingers; its picture does not depend on the texture. The tactile camera
//! looks at a gel from behind, which is plain until it is pressed on the block.

use std::f64::consts::TAU;

use rapid_core::random::Random;

use super::touch::{Touch, pixels};
use super::world::{Texture, World, stream};

/// Pixels per side.
pub const SIDE_PIXELS: u32 = 96;
/// The same as `usize`.
pub const SIDE: usize = SIDE_PIXELS as usize;
pub(super) const PIXELS: usize = SIDE * SIDE;
const WRIST_GRAIN: f32 = 0.015;

/// The appearance of one trial, drawn once from its seed.
#[derive(Debug)]
pub struct Looks {
    table: [f32; 3],
    block: [f32; 3],
    phases: [f64; 3],
    gain: f32,
    /// The gel at rest, and the change at full pressure: RGB of each pixel.
    gel: Vec<[f32; 3]>,
    imprint: Vec<[f32; 3]>,
    /// Standard deviation of its noise.
    tactile_noise: f32,
    wrist_grain: Random,
    tactile_grain: Random,
}

/// Offset of a pixel from the middle of the picture.
pub(super) fn offset(pixel: usize) -> f64 {
    pixel as f64 - (SIDE as f64 - 1.0) / 2.0
}

impl Looks {
    /// The appearance of trial `seed`, in which the block has `texture`.
    pub fn new(seed: u64, texture: Texture) -> Self {
        let touch = Touch::new(seed);
        let mut random = Random::new(seed, stream::LOOKS);
        let mut colour = |low, high| [(); 3].map(|()| narrow(random.uniform(low, high)));
        let table = colour(0.35, 0.6);
        let tint = colour(-0.08, 0.08);
        let block = [0.75 + tint[0], 0.55 + tint[1], 0.2 + tint[2]];
        let base = colour(-0.05, 0.05);
        let base = [0.42 + base[0], 0.45 + base[1], 0.48 + base[2]];
        let slant = [colour(-0.06, 0.06), colour(-0.06, 0.06)];
        let phases = [(); 3].map(|()| random.uniform(0.0, TAU));
        let gain = narrow(random.uniform(0.85, 1.15));
        let gel = pixels()
            .map(|(u, v)| {
                let (u, v) = (narrow(u / 48.0), narrow(v / 48.0));
                std::array::from_fn(|channel| base[channel] + slant[0][channel] * u + slant[1][channel] * v)
            })
            .collect();
        Self {
            table,
            block,
            phases,
            gain,
            gel,
            imprint: touch.imprint(texture),
            tactile_noise: touch.grain,
            wrist_grain: Random::new(seed, stream::WRIST_NOISE),
            tactile_grain: Random::new(seed, stream::TACTILE_NOISE),
        }
    }

    /// The appearance of trial `seed` from now on, with the gel at rest as it is: the fingertip stays the same.
    pub fn next(&mut self, seed: u64, texture: Texture) {
        let gel = std::mem::take(&mut self.gel);
        *self = Self { gel, ..Self::new(seed, texture) };
    }

    /// Renders the wrist camera's picture into `picture`, 96 x 96 x 3 bytes.
    pub fn wrist(&mut self, world: &World, picture: &mut Vec<u8>) {
        let scale = 75.0 / (world.position[2] + 0.45);
        let [p0, p1, p2] = self.phases;
        // The pattern of the table is a sum of waves along x, along y and along both: each needs its sines once per
        // column and once per row.
        let column: [[f64; 3]; SIDE] = std::array::from_fn(|pixel| {
            let x = world.position[0] + offset(pixel) / scale;
            [0.05 * (5.0 * x + p0).sin(), (9.0 * x).sin(), (9.0 * x).cos()]
        });
        let row: [[f64; 3]; SIDE] = std::array::from_fn(|pixel| {
            let y = world.position[1] - offset(pixel) / scale;
            [0.05 * (6.0 * y + p1).sin(), (9.0 * y + p2).sin(), (9.0 * y + p2).cos()]
        });
        let (middle, pixels_per_metre) = if world.held {
            ([0.0, 0.0], 150.0)
        } else {
            let away = [world.block[0] - world.position[0], world.block[1] - world.position[1]];
            ([away[0] * scale, -away[1] * scale], scale)
        };
        let (sin, cos) = world.yaw.sin_cos();
        let half = world.size.half_edge() * pixels_per_metre;
        let fingers = 14.0 + 14.0 * world.grip;
        picture.clear();
        for (v, row) in row.iter().enumerate() {
            for (u, column) in column.iter().enumerate() {
                let (across, down) = (offset(u) - middle[0], offset(v) - middle[1]);
                let (a, b) = (cos * across + sin * down, cos * down - sin * across);
                let colour = if (offset(u).abs() - fingers - 5.0).abs() < 5.0 && offset(v).abs() < 16.0 {
                    [0.12; 3]
                } else if a.abs() < half && b.abs() < half {
                    self.block.map(|channel| channel * narrow(0.9 + 0.1 * a / half))
                } else {
                    let wave = column[0] + row[0] + 0.03 * (column[1] * row[2] + column[2] * row[1]);
                    self.table.map(|channel| channel + narrow(wave))
                };
                let grain = WRIST_GRAIN * self.wrist_grain.normal();
                picture.extend(colour.map(|channel| byte(channel * self.gain + grain)));
            }
        }
    }

    /// Renders the tactile camera's picture into `picture`, 96 x 96 x 3 bytes.
    pub fn tactile(&mut self, world: &World, picture: &mut Vec<u8>) {
        let pressure = narrow(world.pressure);
        picture.clear();
        for (gel, imprint) in self.gel.iter().zip(&self.imprint) {
            for channel in 0..3 {
                let grain = self.tactile_noise * self.tactile_grain.normal();
                picture.push(byte(gel[channel] + pressure * imprint[channel] + grain));
            }
        }
    }
}

#[expect(clippy::cast_possible_truncation, reason = "a colour needs no more than 32 bits")]
pub(super) fn narrow(value: f64) -> f32 {
    value as f32
}

#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to what a byte holds")]
fn byte(value: f32) -> u8 {
    (value.clamp(0.0, 1.0) * 255.0) as u8
}
