//! `[module.NAME]`: what is mounted on the gripper, one module in each slot.

use serde::Serialize;

use super::Mount;

/// `[module.NAME]`: a part that is mounted on the gripper, either with sensors or purely mechanical (paper, section
/// "Module Catalog").
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ModuleSpec {
    /// Its name, as a modality's.
    pub name: String,
    /// Its position.
    #[serde(rename = "slot")]
    pub mount: Mount,
    /// Tags of episodes with it: keys and values.
    pub tags: Vec<(String, String)>,
    /// The entries of its sensors; a module without any is mounted only if `--module` names it.
    pub devices: Vec<String>,
    /// Where its sensors sit, as far as it is known.
    pub transforms: Vec<TransformSpec>,
}

/// `[module.NAME.transform.SENSOR]`: where a sensor sits while its module is mounted.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TransformSpec {
    /// The entry of the sensor, which is the name of its frame too.
    pub sensor: String,
    /// The frame in which it is given.
    pub parent: String,
    /// In m.
    pub position: [f64; 3],
    /// A quaternion `x y z w` of length 1.
    pub rotation: [f64; 4],
}

/// Why modules cannot be mounted as requested.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ModuleError {
    /// There is no such module.
    #[error("--module {name}: no [module.{name}] in the registry; {fix}")]
    Unknown {
        /// The name that was given.
        name: String,
        /// The known modules.
        fix: String,
    },
    /// Two in one slot.
    #[error("--module {first} and --module {second} both sit in the slot {mount}: name the one that is mounted")]
    SameSlot {
        /// One.
        first: String,
        /// The other.
        second: String,
        /// The slot.
        mount: Mount,
    },
}

/// The modules of these names.
///
/// # Errors
/// When one is unknown, or two are in one slot.
pub fn mounted<'a>(modules: &'a [ModuleSpec], names: &[String]) -> Result<Vec<&'a ModuleSpec>, ModuleError> {
    let mut found: Vec<&ModuleSpec> = Vec::new();
    for name in names {
        let Some(module) = modules.iter().find(|module| module.name == *name) else {
            let fix = if modules.is_empty() {
                "it names no modules: write one, or use --tag".to_owned()
            } else {
                crate::did_you_mean(name, modules.iter().map(|module| &module.name), "modules are")
            };
            return Err(ModuleError::Unknown { name: name.clone(), fix });
        };
        if let Some(other) = found.iter().find(|other| other.mount == module.mount && other.name != module.name) {
            let (first, second) = (other.name.clone(), module.name.clone());
            return Err(ModuleError::SameSlot { first, second, mount: module.mount });
        }
        if !found.contains(&module) {
            found.push(module);
        }
    }
    Ok(found)
}
