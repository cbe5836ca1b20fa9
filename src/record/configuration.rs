//! The configuration an episode is recorded with: modules, tags, and the sensors that were present.
//!
//! Pure.

use serde::Serialize;

use crate::mask::PhysicalMask;
use crate::registry::Registry;

/// See the module's comment. As JSON the value of [`KEY`] in the metadata of an episode's beginning.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize)]
pub(super) struct Configuration {
    /// Modules that are mounted: those that were said to be, and those whose sensors are all present.
    pub(super) modules: Vec<String>,
    /// Modalities whose bits are set when the episode begins, ascending by bit.
    pub(super) present: Vec<String>,
    /// Those of the user, then those of the modules whose keys the user did not use.
    #[serde(skip)]
    pub(super) tags: Vec<(String, String)>,
}

/// Key of the configuration in the metadata of an episode's beginning.
pub(super) const KEY: &str = "configuration";

impl Configuration {
    /// With the modules and tags that were said, and the mask of the beginning.
    pub(super) fn of(registry: &Registry, said: &[String], tags: &[(String, String)], mask: PhysicalMask) -> Self {
        let is_present = |name: &String| registry.named(name).is_some_and(|device| mask.contains(device.id));
        let mut found = Self {
            modules: Vec::new(),
            present: registry.devices.iter().map(|device| device.name.clone()).filter(is_present).collect(),
            tags: tags.to_vec(),
        };
        for module in &registry.modules {
            let sensed = !module.devices.is_empty() && module.devices.iter().all(is_present);
            if !sensed && !said.contains(&module.name) {
                continue;
            }
            found.modules.push(module.name.clone());
            for (key, value) in &module.tags {
                if !tags.iter().any(|(own, _)| own == key) {
                    found.tags.push((key.clone(), value.clone()));
                }
            }
        }
        found
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn modules_are_said_or_seen_and_bring_their_tags() {
        let modules = "\n[module.tactile]\nslot = \"tip\"\ntags = [\"finger=tactile\"]\ndevices = [\"tactile_tip\"]\n\
            [module.soft]\nslot = \"tip\"\ntags = [\"finger=soft\", \"colour=red\"]\n[module.never]\nslot = \"front\"\n";
        let registry = Registry::parse(&format!("{}{modules}", crate::registry::BUILTIN), None).unwrap().registry;
        let of = |said: &[&str], tags: &[(&str, &str)], mask| {
            let said: Vec<String> = said.iter().map(|name| (*name).to_owned()).collect();
            let tags: Vec<_> = tags.iter().map(|(key, value)| ((*key).to_owned(), (*value).to_owned())).collect();
            let found = Configuration::of(&registry, &said, &tags, PhysicalMask(mask));
            let tags: Vec<String> = found.tags.iter().map(|(key, value)| format!("{key}={value}")).collect();
            format!("{} | {} | {}", found.modules.join(" "), found.present.join(" "), tags.join(" "))
        };
        assert_eq!(of(&[], &[], 0b101), " | cam_wrist motor_state | ");
        assert_eq!(of(&[], &[], 0b011), "tactile | cam_wrist tactile_tip | finger=tactile");
        assert_eq!(of(&["soft"], &[], 0b001), "soft | cam_wrist | finger=soft colour=red");
        assert_eq!(of(&["soft"], &[("finger", "mine")], 0), "soft |  | finger=mine colour=red");
    }
}
