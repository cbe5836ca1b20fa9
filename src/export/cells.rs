//! The values of a row in a dataset.
//!
//! Invariant: of a modality that is not there, or whose sample cannot be used, pictures are black and numbers zero, and it
//! is not valid. A picture in JPEG is copied as `picture` says.

use std::borrow::Cow;
use std::rc::Rc;

use rapid_core::modality::ModalityKind;
use rapid_pictures::pixels::Pixels;

use super::features::{Axis, Features, Origin};
use super::picture::{self, Pictures};
use super::rows::{Payload, Refusal, Row};
use super::survey::{is_usable, narrow};
use super::video::Damaged;

/// The values of a row.
#[derive(Debug, Default)]
pub(super) struct Cells<'a> {
    /// The file of each camera's picture; none if they are in videos.
    pub(super) pictures: Vec<Cow<'a, [u8]>>,
    pub(super) state: Vec<f32>,
    pub(super) action: Vec<f32>,
    /// By modality, 0 or 1.
    pub(super) mask: Vec<f32>,
    pub(super) plugged: Vec<f32>,
    pub(super) valid: Vec<f32>,
    /// By modality, seconds; 0 without a sample.
    pub(super) age: Vec<f64>,
    pub(super) time_ns: i64,
}

#[derive(Debug)]
pub(super) struct CellMaker<'f> {
    features: &'f Features,
    kinds: Vec<ModalityKind>,
    /// A black picture of each camera.
    black: Vec<Vec<u8>>,
    pixels: Pixels,
    /// Pictures that a video does not have, and which are therefore not valid.
    pub(super) damaged: Damaged,
}

impl<'f> CellMaker<'f> {
    /// For rows of an episode whose modalities are of these kinds.
    pub(super) fn new(features: &'f Features, kinds: Vec<ModalityKind>) -> Result<Self, Refusal> {
        let cameras = if features.pictures == Pictures::Files { &*features.cameras } else { &[] };
        let black = cameras.iter().map(|(_, shape)| picture::black(*shape)).collect::<Result<_, _>>();
        let black = black.map_err(|error| Refusal::Different(error.to_string()))?;
        Ok(Self { features, kinds, black, pixels: Pixels::default(), damaged: Damaged::new() })
    }

    pub(super) fn cells<'a>(&mut self, row: &'a Row<'_>) -> Result<Cells<'a>, Refusal>
    where
        'f: 'a,
    {
        let usable = |(place, sample): (usize, &'a Option<Rc<Payload>>)| -> Option<&'a Payload> {
            let kind = self.kinds.get(place)?;
            let payload = sample.as_deref().filter(|payload| is_usable(*kind, payload));
            payload.filter(|_| !self.damaged.contains(&(place, row.number)))
        };
        // By modality.
        let usable: Vec<Option<&'a Payload>> = row.samples.iter().enumerate().map(usable).collect();
        let sample = |place: usize| usable.get(place).copied().flatten();
        let number = |axis: &Axis| {
            let numbers: &[f64] = match (axis.origin, axis.origin.modality().and_then(sample)) {
                (Origin::Topic, _) => row.action,
                (Origin::Modality(_), Some(Payload::Numbers(numbers))) => numbers,
                (Origin::Modality(_), _) => &[],
            };
            numbers.get(axis.at).map_or(0.0, |number| narrow(*number))
        };
        let mut cells = Cells { time_ns: i64::try_from(row.time_ns).unwrap_or(i64::MAX), ..Cells::default() };
        cells.state.extend(self.features.state.iter().map(number));
        cells.action.extend(self.features.action.iter().map(number));
        for (place, slot) in row.slots.iter().enumerate() {
            let flag = |is_set: bool| f32::from(u8::from(is_set));
            let has_sample = sample(place).is_some();
            cells.mask.push(flag(slot.present));
            cells.plugged.push(flag(slot.plugged));
            cells.valid.push(flag(slot.valid && has_sample));
            cells.age.push(if has_sample { slot.age_ns as f64 / 1e9 } else { 0.0 });
        }
        let pictures: Vec<_> = self.features.cameras.iter().map(|(place, _)| sample(*place)).collect();
        for (payload, black) in pictures.into_iter().zip(&self.black) {
            cells.pictures.push(match payload {
                Some(payload) => {
                    picture::file(payload, &mut self.pixels).map_err(|error| Refusal::Different(error.to_string()))?
                }
                None => Cow::Owned(black.clone()),
            });
        }
        Ok(cells)
    }
}
