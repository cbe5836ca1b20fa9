//! `[module.NAME]`: something that is mounted on the gripper.

use serde::Serialize;

use super::Mount;

/// A module, of those that bear sensors and those that are mechanics alone (paper, section "Module
/// Catalog").
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct ModuleSpec {
    /// Its name, as a modality's.
    pub name: String,
    /// Where it sits.
    #[serde(rename = "slot")]
    pub mount: Mount,
    /// What an episode with it is tagged with: keys and values.
    pub tags: Vec<(String, String)>,
    /// The entries of its sensors; a module without any is known to be mounted only by being said to.
    pub devices: Vec<String>,
}

/// Why modules cannot be mounted as it was said.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ModuleError {
    /// There is no such module.
    #[error("--module {name}: no [module.{name}] in the registry; {fix}")]
    Unknown {
        /// What was said.
        name: String,
        /// What there is.
        fix: String,
    },
    /// Two of one slot.
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
/// When one is not known, or two sit in one slot.
pub fn mounted<'a>(modules: &'a [ModuleSpec], names: &[String]) -> Result<Vec<&'a ModuleSpec>, ModuleError> {
    let mut found: Vec<&ModuleSpec> = Vec::new();
    for name in names {
        let Some(module) = modules.iter().find(|module| module.name == *name) else {
            let known: Vec<&str> = modules.iter().map(|module| module.name.as_str()).collect();
            let fix = if known.is_empty() {
                "it names no modules: write one, or say it with --tag".to_owned()
            } else {
                crate::registry::did_you_mean(name, &known, "modules are")
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
