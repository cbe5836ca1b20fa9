//! Metadata of channels: what a reader needs to know of a topic besides its schema.

use std::collections::BTreeMap;

use rapid_core::modality::ModalityKind;
use rapid_registry::{ActionSpec, DeviceSpec, NodeSpec};

use super::form::Derived;
use super::text_map;

/// Of the topic of a device.
pub fn of_device(device: &DeviceSpec) -> BTreeMap<String, String> {
    let kind = serde_json::to_value(device.modality().kind).ok();
    let kind = kind.as_ref().and_then(|kind| kind.as_str()).unwrap_or_default().to_owned();
    let mut metadata = text_map([("modality", device.name.clone()), ("bit", device.id.to_string()), ("kind", kind)]);
    if let (NodeSpec::Camera(camera), ModalityKind::Depth) = (&device.node, device.modality().kind) {
        metadata.insert("depth_unit_um".to_owned(), camera.depth_unit_um.to_string());
    }
    metadata
}

/// Of a topic derived from that of a device; that of transforms is derived from several.
pub fn of_derived(device: &DeviceSpec, derived: Derived) -> BTreeMap<String, String> {
    match derived {
        Derived::Transform => BTreeMap::new(),
        Derived::Pose | Derived::Joints | Derived::Calibration | Derived::Points => {
            text_map([("derived_from", device.topic.clone())])
        }
    }
}

/// Of the topic of actions, which move `device`.
pub fn of_action(device: &DeviceSpec, action: &ActionSpec) -> BTreeMap<String, String> {
    let (names, units) = (serde_json::json!(action.names), serde_json::json!(action.units));
    text_map([("actuator", device.name.clone()), ("names", names.to_string()), ("units", units.to_string())])
}
