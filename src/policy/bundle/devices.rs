//! A bundle against the rig it is to run on.

use super::read::Problems;
use super::spec::{Bundle, BundleErrors, ImageSpec, ObservationInput, VectorSpec};
use crate::modality::ModalityKind;
use crate::registry::{Registry, did_you_mean};

impl Bundle {
    /// Are all the modalities it observes in the registry, of the kind and size it expects?
    ///
    /// # Errors
    /// Every observation that is not.
    pub fn check_registry(&self, registry: &Registry) -> Result<(), BundleErrors> {
        let mut problems = Problems::new(&self.label());
        let known: Vec<&str> = registry.devices.iter().map(|device| device.name.as_str()).collect();
        for (at, observation) in self.observations.iter().enumerate() {
            let entry = format!("observations[{at}]");
            let name = &observation.modality;
            let Some(device) = registry.named(name) else {
                let message = format!("modality \"{name}\" is not in devices.toml");
                problems.report(&entry, message, did_you_mean(name, &known, "the modalities of this rig are"));
                continue;
            };
            let modality = device.modality();
            match (&observation.input, modality.kind) {
                (ObservationInput::Image(image), ModalityKind::Image) => {
                    picture(&entry, name, image, &modality.shape, &mut problems);
                }
                (ObservationInput::Vector(vector), ModalityKind::Scalars) => {
                    let channels = modality.shape.first().map_or(0, |channels| *channels as usize);
                    numbers(&entry, name, vector, channels, &mut problems);
                }
                (input, kind) => {
                    let wanted = match input {
                        ObservationInput::Image(_) => "pictures",
                        ObservationInput::Vector(_) => "numbers",
                    };
                    let given = match kind {
                        ModalityKind::Image => "pictures",
                        ModalityKind::Scalars => "numbers",
                        ModalityKind::Bytes => "bytes that nobody looks into",
                    };
                    let message = format!("wants {wanted}, but the device \"{name}\" gives {given}");
                    let fix = format!("give [device.{name}] in devices.toml a device that gives {wanted}");
                    problems.report(&entry, message, fix);
                }
            }
        }
        problems.check()
    }

    /// Is what it moves among `actuators`, each with the number of values of an action?
    ///
    /// # Errors
    /// When it is not, or its actions are of another length.
    pub fn check_actuators(&self, actuators: &[(&str, usize)]) -> Result<(), BundleErrors> {
        let mut problems = Problems::new(&self.label());
        let (wanted, len) = (self.action.actuator.as_str(), self.action.len());
        match actuators.iter().find(|(name, _)| *name == wanted) {
            Some((_, values)) if *values == len => {}
            Some((_, values)) => {
                let message = format!("has {len} values, but \"{wanted}\" takes {values}");
                let fix = format!("correct [device.{wanted}.action] in devices.toml, or take another bundle");
                problems.report("action", message, fix);
            }
            None => {
                let names: Vec<&str> = actuators.iter().map(|(name, _)| *name).collect();
                let fix = if names.is_empty() {
                    format!(
                        "no device there takes actions: add motors behind a CAN adapter, or a program that moves \
                         \"{wanted}\" and has the table [device.{wanted}.action]"
                    )
                } else {
                    did_you_mean(wanted, &names, "devices that take actions are")
                };
                problems.report("action", format!("actuator \"{wanted}\" takes no actions in devices.toml"), fix);
            }
        }
        problems.check()
    }
}

fn picture(entry: &str, name: &str, image: &ImageSpec, shape: &[u32], problems: &mut Problems) {
    // Resized, any size will do.
    let (None, [height, width]) = (image.resize, shape) else { return };
    let (height, width) = (*height as usize, *width as usize);
    let wanted = image.crop.unwrap_or([image.height, image.width]);
    let fits = match image.crop {
        Some(crop) => crop[0] <= height && crop[1] <= width,
        None => wanted == [height, width],
    };
    if !fits {
        let than = if image.crop.is_some() { "at least " } else { "" };
        let message = format!(
            "wants pictures of {than}{}x{} (height x width), but \"{name}\" gives {height}x{width}",
            wanted[0], wanted[1]
        );
        let fix = format!(
            "set width = {} and height = {} in devices.toml, or \"resize\": [{}, {}] here",
            wanted[1], wanted[0], wanted[0], wanted[1]
        );
        problems.report(entry, message, fix);
    }
}

fn numbers(entry: &str, name: &str, vector: &VectorSpec, channels: usize, problems: &mut Problems) {
    match &vector.slice {
        Some(slice) if slice.end > channels => {
            let message = format!("slice ends at {}, but \"{name}\" gives {channels} numbers", slice.end);
            problems.report(entry, message, format!("correct the slice, or channels of \"{name}\" in devices.toml"));
        }
        None if vector.len != channels => {
            let message = format!("wants {} numbers, but \"{name}\" gives {channels}", vector.len);
            let fix = format!("write \"slice\": [begin, end], or correct channels of \"{name}\" in devices.toml");
            problems.report(entry, message, fix);
        }
        _ => {}
    }
}
