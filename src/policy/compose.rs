//! From the network's output to actions that can be executed: absolute poses.
//!
//! With T0 the pose at the tick of the newest observation, and A the pose of an action in the output:
//!
//! * `absolute`: the target is A.
//! * `relative`: T0 A; without a rotation p0 + d.
//! * `delta`: p + d and D R, with p and R the target of the action before. The action of index `action_start` belongs to
//!   T0's tick and starts from T0. That is what training learns (`Dataset._actions`): actions up to this index are steps
//!   from the pose of their own tick, the next ones from the target before. Actions before `action_start` are past and
//!   never executed; T0 stands in their place.
//!
//! What is executed is the position, the quaternion `x y z w` of length 1 if there is a rotation, and the rest of the
//! output as it is. Of a quaternion and its negative, the same rotation, that nearer to the one before is taken, so that
//! no axis jumps; the first is near T0's or, where actions are absolute, has w not negative.
//!
//! Invariant: pure; nothing here allocates after construction, and no input causes a panic.
//! Invariant: a chunk is composed as a whole or not at all.

use std::ops::Range;

use rapid_core::rotation::{self, Quaternion};
use rapid_core::sample::Encoding;

use super::bundle::{ActionRotation, BasePose, Bundle, POSITION, QUATERNION, Representation};
use super::horizon::ChunkError;
use super::request::{Cell, Request};

/// See the module's comment.
#[derive(Debug)]
pub struct Composer {
    representation: Representation,
    rotation: Option<ActionRotation>,
    action_start: usize,
    /// Observation steps.
    steps: usize,
    horizon: usize,
    /// Values of an action in the output, and of an executed one.
    outputs: usize,
    executed: usize,
}

/// A pose; without a rotation, one that is not turned.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Pose {
    position: [f64; 3],
    rotation: Quaternion,
}

impl Composer {
    /// For the actions of a bundle.
    pub fn new(bundle: &Bundle) -> Self {
        Self {
            representation: bundle.action.representation.clone(),
            rotation: bundle.action.rotation,
            action_start: bundle.action_start,
            steps: bundle.n_obs_steps,
            horizon: bundle.horizon,
            outputs: bundle.action.outputs(),
            executed: bundle.action.len(),
        }
    }

    /// Numbers of an executed chunk: horizon x values of an executed action.
    pub const fn chunk_len(&self) -> usize {
        self.horizon * self.executed
    }

    /// Writes into `actions`, `[Tp, executed values]`, what is executed of `output`, `[Tp, Da]` denormalised, the answer
    /// to `request`. If that fails, `actions` is NaN throughout. So it is if the output is not finite: the
    /// action queue refuses it.
    ///
    /// # Errors
    /// When `output` or `actions` has another length, a rotation of the output is invalid, or the request has no pose that
    /// the output is relative to.
    pub fn compose(&self, request: &Request, output: &[f32], actions: &mut [f32]) -> Result<(), ChunkError> {
        let composed = self.try_compose(request, output, actions);
        if composed != Ok(true) {
            actions.fill(f32::NAN);
        }
        composed.map(|_| ())
    }

    /// The same. Returns whether the output is finite; where it is not, or on an error, `actions` is invalid.
    fn try_compose(&self, request: &Request, output: &[f32], actions: &mut [f32]) -> Result<bool, ChunkError> {
        if output.len() != self.horizon * self.outputs || actions.len() != self.chunk_len() {
            return Err(ChunkError::Length);
        }
        if !output.iter().all(|value| value.is_finite()) {
            return Ok(false);
        }
        let base = match self.representation.base() {
            None if self.rotation.is_none() => {
                actions.copy_from_slice(output);
                return Ok(true);
            }
            None => Pose { position: [0.0; 3], rotation: rotation::NONE },
            Some(base) => self.base(base, request).ok_or(ChunkError::NoBase)?,
        };
        let (mut before, mut near) = (base, base.rotation);
        let outputs = output.chunks_exact(self.outputs.max(1));
        for (index, (output, action)) in outputs.zip(actions.chunks_exact_mut(self.executed.max(1))).enumerate() {
            let (given, rest) = self.given(output).ok_or(ChunkError::NoRotation)?;
            let target = match &self.representation {
                Representation::Absolute => given,
                Representation::Relative(_) => self.turned(base, given),
                Representation::Delta(_) if index < self.action_start => base,
                Representation::Delta(_) => {
                    let position = sum(before.position, given.position);
                    before = Pose { position, rotation: rotation::product(given.rotation, before.rotation) };
                    before
                }
            };
            // Products of many rotations drift from length 1.
            let turned = rotation::normalized(target.rotation).ok_or(ChunkError::NoRotation)?;
            near = rotation::nearer(turned, near);
            let turned = if self.rotation.is_some() { &near[..] } else { &[] };
            let pose = target.position.iter().chain(turned);
            #[expect(clippy::cast_possible_truncation, reason = "what becomes infinite is refused by the queue")]
            let pose = pose.map(|value| *value as f32);
            for (place, value) in action.iter_mut().zip(pose.chain(rest.iter().copied())) {
                *place = value;
            }
        }
        Ok(true)
    }

    /// The pose of an action in the output, and the rest of it. `None` if its rotation is invalid.
    fn given<'a>(&self, output: &'a [f32]) -> Option<(Pose, &'a [f32])> {
        let (position, rest) = output.split_first_chunk::<POSITION>()?;
        let (rotation, rest) = match self.rotation {
            None => (rotation::NONE, rest),
            Some(ActionRotation::Rotation6d) => {
                let (first, rest) = rest.split_first_chunk::<3>()?;
                let (second, rest) = rest.split_first_chunk::<3>()?;
                (rotation::of_rows([first, second].map(|row| row.map(f64::from)))?, rest)
            }
            Some(ActionRotation::Quaternion) => {
                let (four, rest) = rest.split_first_chunk::<QUATERNION>()?;
                (rotation::of_four(four.map(f64::from))?, rest)
            }
        };
        Some((Pose { position: position.map(f64::from), rotation }, rest))
    }

    /// `given` as seen from `base`, in the frame of `base`.
    fn turned(&self, base: Pose, given: Pose) -> Pose {
        // Without a rotation of its own an action is in the axes of the frame in which poses are given.
        let far =
            if self.rotation.is_some() { rotation::turned(base.rotation, given.position) } else { given.position };
        Pose { position: sum(base.position, far), rotation: rotation::product(base.rotation, given.rotation) }
    }

    /// T0: the pose in the newest sample of its modality. `None` if that has none.
    fn base(&self, base: &BasePose, request: &Request) -> Option<Pose> {
        if !request.is_present(base.observation) {
            return None;
        }
        let cell = request.cell(base.observation, self.steps.checked_sub(1)?)?;
        let rotation = match &base.rotation {
            None => rotation::NONE,
            Some(range) => rotation::normalized(numbers(cell, range)?)?,
        };
        Some(Pose { position: numbers(cell, &base.position)?, rotation })
    }
}

/// Numbers of a sample; `None` if it has not all of them, or one is not finite.
fn numbers<const N: usize>(cell: &Cell, range: &Range<usize>) -> Option<[f64; N]> {
    if cell.encoding != Some(Encoding::F64) {
        return None;
    }
    let (all, _) = cell.bytes.as_chunks::<8>();
    let mut numbers = [0.0; N];
    for (place, bytes) in numbers.iter_mut().zip(all.get(range.clone())?) {
        *place = f64::from_le_bytes(*bytes);
    }
    (range.len() == N && numbers.iter().all(|number| number.is_finite())).then_some(numbers)
}

fn sum(one: [f64; 3], other: [f64; 3]) -> [f64; 3] {
    [one[0] + other[0], one[1] + other[1], one[2] + other[2]]
}

#[cfg(test)]
mod tests;
