//! The module catalogue: descriptors of types of modules, those of the paper (appendix "Module Catalog") as files beside
//! this one, and others from a user's files.
//!
//! A descriptor is a part of a `devices.toml`: one `[module.NAME]`, and for each of its sensors that an entry is to be made for,
//! a `[device.NAME]` without what belongs to one unit: identity and bit.
//!
//! Invariant: any text is survived, and no descriptor is read whose keys could be anything else than settings of its sensor.

use toml::{Table, Value};

use super::diagnostic::did_you_mean;
use super::edit::Setting;
use super::spec::Mount;

/// The descriptors that are part of the program.
const CATALOGUE: [&str; 9] = [
    include_str!("catalogue/finger_parallel_jaw.toml"),
    include_str!("catalogue/finger_pinch.toml"),
    include_str!("catalogue/tip_rigid.toml"),
    include_str!("catalogue/tip_soft.toml"),
    include_str!("catalogue/tip_tactile.toml"),
    include_str!("catalogue/wrist_mount.toml"),
    include_str!("catalogue/wrist_mount_angled.toml"),
    include_str!("catalogue/handheld_adapter.toml"),
    include_str!("catalogue/robot_adapter.toml"),
];

/// A type of module.
#[derive(Debug, Clone, PartialEq)]
pub struct Descriptor {
    /// Its name.
    pub name: String,
    /// What it is, from its first comment.
    pub title: String,
    /// Where it sits.
    pub mount: Mount,
    /// Tags of episodes with it, `KEY=VALUE`.
    pub tags: Vec<String>,
    /// The entries of its sensors.
    pub devices: Vec<String>,
    /// Those that an entry is made for: name, and keys with their values; `camera.width` is one of `[device.NAME.camera]`.
    pub sensors: Vec<(String, Vec<(String, Setting)>)>,
    /// Where they sit: `[module.NAME.transform]`.
    pub transforms: Vec<(String, Vec<(String, Setting)>)>,
    /// The whole of it.
    pub text: String,
}

/// Why a text is no descriptor, or there is none of a name.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum CatalogueError {
    /// None has this name.
    #[error(
        "there is no module {name:?} in the catalogue: {fix}, or write the path of a descriptor (`rapid modules` lists them)"
    )]
    Unknown {
        /// The name.
        name: String,
        /// What may have been meant.
        fix: String,
    },
    /// It is not TOML.
    #[error("the descriptor is not TOML: {0}")]
    Syntax(String),
    /// Something of it is wrong.
    #[error("the descriptor: {0}")]
    Wrong(String),
}

/// All descriptors of the program, in the order of the paper.
///
/// # Errors
/// Never: a test reads them.
pub fn all() -> Result<Vec<Descriptor>, CatalogueError> {
    CATALOGUE.iter().map(|text| parse(text)).collect()
}

/// The descriptor of this name.
///
/// # Errors
/// When there is none.
pub fn named(name: &str) -> Result<Descriptor, CatalogueError> {
    let all = all()?;
    let fix = did_you_mean(name, all.iter().map(|descriptor| &descriptor.name), "modules are");
    let found = all.into_iter().find(|descriptor| descriptor.name == name);
    found.ok_or_else(|| CatalogueError::Unknown { name: name.to_owned(), fix })
}

/// Reads a descriptor.
///
/// # Errors
/// When it is not a descriptor.
pub fn parse(text: &str) -> Result<Descriptor, CatalogueError> {
    let wrong = |what: &str| CatalogueError::Wrong(what.to_owned());
    let root: Table =
        text.parse().map_err(|error: toml::de::Error| CatalogueError::Syntax(error.message().to_owned()))?;
    if let Some(other) = root.keys().find(|key| !["module", "device"].contains(&key.as_str())) {
        return Err(CatalogueError::Wrong(format!("{other:?} is neither [module.NAME] nor [device.NAME]")));
    }
    let tables = |key: &str| root.get(key).and_then(Value::as_table);
    let modules = tables("module").ok_or_else(|| wrong("it has no [module.NAME]"))?;
    let (Some((name, module)), 1) = (modules.iter().next(), modules.len()) else {
        return Err(wrong("it describes one module: write one [module.NAME]"));
    };
    let module = module.as_table().ok_or_else(|| wrong("[module.NAME] is not a table"))?;
    if let Some(other) = module.keys().find(|key| !["slot", "tags", "devices", TRANSFORM].contains(&key.as_str())) {
        return Err(CatalogueError::Wrong(format!(
            "[module.{name}] has no key {other:?}: slot, tags, devices and transform"
        )));
    }
    let slot = module.get("slot").and_then(Value::as_str).unwrap_or_default();
    let mount = Mount::WORDS.iter().find(|(word, _)| *word == slot).map(|(_, mount)| *mount);
    let mount = mount.ok_or_else(|| wrong("its slot is not one of front, tip, top and bottom"))?;
    let texts = |key: &str| -> Result<Vec<String>, CatalogueError> {
        let list = module.get(key).map_or(Some(&[][..]), |value| value.as_array().map(Vec::as_slice));
        let texts = list.and_then(|list| list.iter().map(|item| item.as_str().map(str::to_owned)).collect());
        texts.ok_or_else(|| CatalogueError::Wrong(format!("{key} is not a list of texts")))
    };
    let devices = texts("devices")?;
    let mut sensors = Vec::new();
    for (sensor, value) in tables("device").into_iter().flatten() {
        let table = value.as_table().ok_or_else(|| wrong("[device.NAME] is not a table"))?;
        if !devices.contains(sensor) {
            return Err(CatalogueError::Wrong(format!(
                "[device.{sensor}] is not among the devices of [module.{name}]"
            )));
        }
        if let Some(own) = table.keys().find(|key| !OF_A_TYPE.contains(&key.as_str())) {
            return Err(CatalogueError::Wrong(format!(
                "{own} of [device.{sensor}] belongs to a unit or a rig, not to a type of module: {}",
                OF_A_TYPE.join(", ")
            )));
        }
        if !table.contains_key("node") {
            return Err(CatalogueError::Wrong(format!("[device.{sensor}] has no node")));
        }
        let mut keys = Vec::new();
        flatten("", table, &mut keys);
        sensors.push((sensor.clone(), keys));
    }
    let mut transforms = Vec::new();
    for (sensor, place) in module.get(TRANSFORM).and_then(Value::as_table).into_iter().flatten() {
        let place = place.as_table().filter(|_| devices.contains(sensor));
        let place =
            place.ok_or_else(|| wrong("transform: write [module.NAME.transform.SENSOR] for one of its devices"))?;
        let mut keys = Vec::new();
        flatten("", place, &mut keys);
        transforms.push((sensor.clone(), keys));
    }
    let tags = texts("tags")?;
    if let Some(tag) = tags.iter().find(|tag| tag.split_once('=').is_none_or(|(key, _)| key.is_empty())) {
        return Err(CatalogueError::Wrong(format!("{tag:?} is not a tag: write KEY=VALUE, as \"finger=soft\"")));
    }
    let title = text.lines().next().and_then(|line| line.strip_prefix('#')).unwrap_or_default().trim().to_owned();
    let (name, text) = (name.clone(), text.to_owned());
    Ok(Descriptor { name, title, mount, tags, devices, sensors, transforms, text })
}

/// Where the sensors of a module sit.
const TRANSFORM: &str = "transform";

/// Keys of an entry that are the same for every unit of a type.
const OF_A_TYPE: [&str; 17] = [
    "node",
    "camera",
    "tty",
    "can",
    "lan",
    "process",
    "verdict",
    "pose",
    "joints",
    "calibration",
    "points",
    "slot",
    "stall_after",
    "max_bytes",
    "depth",
    "when_stale",
    "latency",
];

fn flatten(before: &str, table: &Table, keys: &mut Vec<(String, Setting)>) {
    for (key, value) in table {
        let key = format!("{before}{key}");
        match value {
            Value::Table(inner) => flatten(&format!("{key}."), inner, keys),
            Value::String(text) => keys.push((key, Setting::Text(text.clone()))),
            Value::Integer(whole) => keys.push((key, Setting::Whole(*whole))),
            other => keys.push((key, Setting::Typed(other.to_string()))),
        }
    }
}

impl Descriptor {
    /// How its sensors come up: `usb`, `net`, or nothing without any (the column "Bring-up" of the paper's table).
    pub fn bring_up(&self) -> &'static str {
        let is_net = |(_, keys): &(String, Vec<(String, Setting)>)| {
            keys.iter().any(|(key, value)| key == "node" && *value == Setting::Text("lan".to_owned()))
        };
        match self.sensors.as_slice() {
            [] => "",
            sensors if sensors.iter().any(is_net) => "net",
            _ => "usb",
        }
    }
}

#[cfg(test)]
mod tests {
    use Mount::{Bottom, Front, Tip, Top};
    use proptest::prelude::*;

    use super::*;
    use crate::Registry;

    #[test]
    fn the_catalogue_is_that_of_the_paper() {
        let all = all().unwrap();
        let rows: Vec<_> =
            all.iter().map(|descriptor| (descriptor.mount, descriptor.devices.len(), descriptor.bring_up())).collect();
        let (none, usb, net) = ((0, ""), (1, "usb"), (1, "net"));
        let wanted = [
            (Front, none),
            (Front, none),
            (Tip, none),
            (Tip, none),
            (Tip, usb),
            (Top, net),
            (Top, net),
            (Bottom, none),
            (Bottom, none),
        ];
        assert_eq!(rows, wanted.map(|(mount, (sensors, bring_up))| (mount, sensors, bring_up)));
        for descriptor in &all {
            assert!(!descriptor.title.is_empty() && descriptor.tags.len() == 1, "{descriptor:?}");
            assert_eq!(named(&descriptor.name).as_ref(), Ok(descriptor));
            // With an identity for its sensor it is a registry.
            let identity = "vid = \"1209\"\npid = \"0001\"\nbit = 5\nnode = ";
            let other = "[device.other]\nvid = \"1\"\npid = \"2\"\nnode = \"camera\"\nbit = 0\n";
            let text = format!("{other}{}", descriptor.text.replace("node = ", identity));
            let registry = Registry::parse(&text, None).unwrap().registry;
            assert_eq!(registry.modules.len(), 1);
            assert_eq!(registry.devices.len(), 1 + descriptor.sensors.len());
        }
        // The mounts differ in where their camera looks; both give its pictures.
        let mounts = ["wrist_mount", "wrist_mount_angled"].map(|name| named(name).unwrap());
        assert_ne!(mounts[0].transforms, mounts[1].transforms);
        for mount in mounts {
            let [(placed, _)] = mount.transforms.as_slice() else { panic!("{mount:?}") };
            let [(sensor, keys)] = mount.sensors.as_slice() else { panic!("{mount:?}") };
            assert_eq!((placed, &mount.devices), (sensor, &vec![sensor.clone()]));
            assert!(keys.contains(&("lan.stream".to_owned(), Setting::Text("preview".to_owned()))), "{keys:?}");
        }
        let error = named("tip_sofd").unwrap_err().to_string();
        assert!(error.contains("did you mean \"tip_soft\"?"), "{error}");
    }

    #[test]
    fn what_is_no_descriptor_is_refused_by_name() {
        for (text, why) in [
            ("", "it has no [module.NAME]"),
            ("[module]", "it describes one module"),
            ("[module.a]\nslot = \"tip\"\n[module.b]\nslot = \"tip\"", "it describes one module"),
            ("module = 3", "it has no [module.NAME]"),
            ("[module.a]", "its slot is not one of front"),
            ("[module.a]\nslot = \"tip\"\ncolour = \"red\"", "no key \"colour\""),
            ("[module.a]\nslot = \"tip\"\ntags = \"x\"", "tags is not a list of texts"),
            ("[rig]\n[module.a]\nslot = \"tip\"", "\"rig\" is neither"),
            ("[module.a]\nslot = \"tip\"\n[device.b]\nnode = \"camera\"", "not among the devices"),
            ("[module.a]\nslot = \"tip\"\ndevices = [\"b\"]\n[device.b]\ndepth = 8", "[device.b] has no node"),
            (
                "[module.a]\nslot = \"tip\"\ndevices = [\"b\"]\n[device.b]\nvid = \"1\"",
                "vid of [device.b] belongs to a unit",
            ),
            (
                "[module.a]\nslot = \"tip\"\ndevices = [\"b\"]\n[device.b]\nnode = \"camera\"\nserial = \"1\"",
                "serial of [device.b] belongs to a unit",
            ),
            (
                "[module.a]\nslot = \"tip\"\ndevices = [\"b\"]\n[device.b]\nnode = \"camera\"\non_attach = [\"sh\"]",
                "on_attach of [device.b] belongs to a unit or a rig",
            ),
            ("[module.a]\nslot = \"tip\"\ntags = [\"x\"]", "\"x\" is not a tag"),
            ("[", "the descriptor is not TOML"),
        ] {
            let error = parse(text).unwrap_err().to_string();
            assert!(error.contains(why), "{text}: {error}");
        }
    }

    proptest! {
        #[test]
        fn any_text_is_survived(text in ".{0,200}") {
            let _ = parse(&text);
        }
    }
}
