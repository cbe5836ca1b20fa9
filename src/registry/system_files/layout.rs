//! `foxglove.json`: a layout for the Foxglove app, with the pictures, the mask, the numbers and the log of the rig.
//!
//! It has the form in which the app exports and imports layouts: the settings of each panel by its id, `KIND!NAME`, and a
//! binary tree of panels. Expressions are message paths
//! (<https://docs.foxglove.dev/docs/visualization/message-path-syntax>).
//!
//! Invariant: a live connection and a recorded file are shown by the same layout: presence, whose topics differ, has a
//! tab for each.
//!
//! The description of an arm is named by its path on this machine: there the desktop app reads it, elsewhere its path is set
//! in the panel.

use std::path::Path;

use rapid_core::action::ACTION_TOPIC;
use rapid_core::mask::MASK_TOPIC;
use rapid_core::modality::ModalityKind;
use rapid_core::observation::OBSERVATION_TOPIC;
use rapid_core::topic::{FRAME_TOPIC, LOG_TOPIC};
use serde_json::{Map, Value, json};

use crate::{CanProtocol, CanSpec, DeviceSpec, Form, NodeSpec, Quantity, Registry};

/// Numbers of a device that are plotted.
const MOST_PLOTTED: u32 = 16;

/// A turn of a LiDAR, seconds: they turn 5 to 20 times a second.
const TURN_S: f64 = 0.2;

/// The text of the file.
pub(super) fn layout(registry: &Registry) -> String {
    let mut panels = Panels::default();
    let of = |kind| registry.devices.iter().filter(move |device| device.modality().kind == kind);
    let cameras = of(ModalityKind::Image).chain(of(ModalityKind::Depth));
    let mut pictures: Vec<_> = cameras.map(|device| panels.picture(device)).collect();
    pictures.extend(panels.scene(registry));
    let mut plots: Vec<_> = of(ModalityKind::Scalars).map(|device| panels.numbers(device)).collect();
    if let Some((_, action)) = registry.actuator() {
        let names: Vec<_> = action.names.iter().map(String::as_str).collect();
        plots.push(panels.plot("action", values(ACTION_TOPIC, names.into_iter())));
    }
    let tabs = [("Live", OBSERVATION_TOPIC), ("Recorded", FRAME_TOPIC)]
        .map(|(title, topic)| json!({ "title": title, "layout": panels.presence(registry, title, topic) }));
    let presence = panels.add("Tab", "presence", json!({ "activeTabIdx": 0, "tabs": tabs }));
    let log = json!({ "searchTerms": [], "minLogLevel": 1, "topicToRender": LOG_TOPIC });
    let log = panels.add("RosOut", "log", log);
    let left = [(tree(&pictures, "row"), 75), (Some(log), 25)];
    let right = [(Some(presence), 40), (tree(&plots, "column"), 60)];
    let halves = [(beside(left, "column"), 60), (beside(right, "column"), 40)];
    let whole = json!({
        "configById": panels.0,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": { "speed": 1 },
        "layout": beside(halves, "row"),
    });
    // A value of texts and numbers always has a form as JSON.
    serde_json::to_string_pretty(&whole).unwrap_or_default() + "\n"
}

/// Settings by id.
#[derive(Default)]
struct Panels(Map<String, Value>);

impl Panels {
    /// Returns the id.
    fn add(&mut self, kind: &str, name: &str, settings: Value) -> Value {
        let id = format!("{kind}!{name}");
        self.0.insert(id.clone(), settings);
        Value::from(id)
    }

    fn picture(&mut self, device: &DeviceSpec) -> Value {
        let mut mode = json!({ "imageTopic": device.topic });
        if let Some(form @ Form::Calibration(_)) = &device.form {
            mode["calibrationTopic"] = json!(format!("{}{}", device.topic, form.ending()));
        }
        let settings = json!({ "foxglovePanelTitle": device.name, "imageMode": mode });
        self.add("Image", &device.name, settings)
    }

    /// Poses, points and arms, if there are any.
    fn scene(&mut self, registry: &Registry) -> Option<Value> {
        let shown = |device: &DeviceSpec| {
            let form = device.form.as_ref()?;
            let (frame, settings) = match form {
                Form::Pose(pose) => (pose.parent.clone(), json!({ "visible": true })),
                // A packet is a part of a turn: what the last ones had is shown together.
                Form::Points(points) => (
                    points.frame.clone(),
                    json!({ "visible": true, "decayTime": TURN_S, "colorMode": "colormap",
                        "colorField": "intensity", "colorMap": "turbo" }),
                ),
                Form::Joints(joints) => (joints.tip.as_ref()?.parent.clone(), json!({ "visible": true })),
                Form::Calibration(_) => return None,
            };
            let ending = form.further_ending().unwrap_or(form.ending());
            Some((format!("{}{ending}", device.topic), frame, settings))
        };
        let shown: Vec<_> = registry.devices.iter().filter_map(shown).collect();
        let (_, frame, _) = shown.first()?;
        let mut topics: Map<_, _> =
            shown.iter().map(|(topic, _, settings)| (topic.clone(), settings.clone())).collect();
        let mut layers = Map::new();
        for device in &registry.devices {
            if let (Some(urdf), Some(form)) = (urdf(device), &device.form) {
                // Their messages move it: the names of its joints are theirs.
                topics.insert(format!("{}{}", device.topic, form.ending()), json!({ "visible": true }));
                layers.insert(device.name.clone(), description(&device.name, urdf));
            }
        }
        let settings = json!({ "foxglovePanelTitle": "space", "followTf": frame, "topics": topics, "layers": layers });
        Some(self.add("3D", "space", settings))
    }

    fn numbers(&mut self, device: &DeviceSpec) -> Value {
        if let Some(form @ Form::Joints(joints)) = &device.form {
            let topic = format!("{}{}", device.topic, form.ending());
            let quantity = joints.quantities.iter().find(|quantity| **quantity != Quantity::Other);
            let quantity = quantity.copied().unwrap_or(Quantity::Position);
            let most = usize::try_from(MOST_PLOTTED).unwrap_or(usize::MAX);
            let paths = joints.names.iter().enumerate().take(most);
            let paths = paths.map(|(index, name)| (format!("{topic}.joints[{index}].{quantity}"), name.as_str()));
            return self.plot(&device.name, paths);
        }
        let count = device.modality().shape.first().copied().unwrap_or_default().min(MOST_PLOTTED);
        let names: Vec<_> = (0..count).map(|index| index.to_string()).collect();
        self.plot(&device.name, values(&device.topic, names.iter().map(String::as_str)))
    }

    /// `series`: the path of each, and its name.
    fn plot<'a>(&mut self, name: &str, series: impl Iterator<Item = (String, &'a str)>) -> Value {
        let one = |(value, label): (String, &str)| json!({ "value": value, "label": label, "enabled": true, "timestampMethod": "receiveTime" });
        let paths: Vec<_> = series.map(one).collect();
        let settings = json!({
            "foxglovePanelTitle": name,
            "paths": paths,
            "showLegend": true,
            "legendDisplay": "floating",
            "isSynced": true,
            "xAxisVal": "timestamp",
        });
        self.add("Plot", name, settings)
    }

    /// The mask, and of each sensor whether it runs and whether it is plugged in at a tick: a driver that crashed differs from
    /// an unplug.
    fn presence(&mut self, registry: &Registry, title: &str, topic: &str) -> Value {
        let state =
            |value: String, label: &str| json!({ "value": value, "label": label, "timestampMethod": "receiveTime" });
        let mask = state(format!("{MASK_TOPIC}.mask"), "mask");
        let sensors = registry.devices.iter().flat_map(|device| {
            let of = |field| format!("{topic}.modalities[:]{{bit=={}}}.{field}", device.id.bit());
            [state(of("present"), &device.name), state(of("plugged"), &format!("{} plugged in", device.name))]
        });
        let paths: Vec<_> = [mask].into_iter().chain(sensors).collect();
        self.add("StateTransitions", title, json!({ "paths": paths, "isSynced": true, "showPoints": false }))
    }
}

/// The description of the arm that a device moves, if it is one.
fn urdf(device: &DeviceSpec) -> Option<&Path> {
    let NodeSpec::Can(CanSpec { protocol: CanProtocol::Damiao(motors), .. }) = &device.node else { return None };
    motors.effector.as_ref().map(|effector| effector.urdf.as_path())
}

/// The layer of a 3D panel that draws the description of an arm, as the app's own SDK writes it.
fn description(name: &str, urdf: &Path) -> Value {
    // Only an empty path has no absolute form.
    let path = std::path::absolute(urdf).unwrap_or_else(|_| urdf.to_owned());
    json!({
        "instanceId": name,
        "layerId": "foxglove.Urdf",
        "label": name,
        "visible": true,
        "sourceType": "filePath",
        "filePath": path.to_string_lossy(),
    })
}

/// The numbers in a message of `topic`, with their names.
fn values<'a>(topic: &'a str, names: impl Iterator<Item = &'a str>) -> impl Iterator<Item = (String, &'a str)> {
    names.enumerate().map(move |(index, name)| (format!("{topic}.values[{index}]"), name))
}

/// Panels of equal size, split in `direction` and then in the other; `None` without any.
fn tree(panels: &[Value], direction: &str) -> Option<Value> {
    match panels {
        [] => None,
        [one] => Some(one.clone()),
        several => {
            let (first, second) = several.split_at(several.len().div_ceil(2));
            let across = if direction == "row" { "column" } else { "row" };
            beside([(tree(first, across), first.len()), (tree(second, across), second.len())], direction)
        }
    }
}

/// Two parts with their shares of the space, or the one that there is.
fn beside(parts: [(Option<Value>, usize); 2], direction: &str) -> Option<Value> {
    match parts {
        [(Some(first), one), (Some(second), other)] => {
            let share = 100 * one / (one + other).max(1);
            Some(json!({ "first": first, "second": second, "direction": direction, "splitPercentage": share }))
        }
        [(first, _), (second, _)] => first.or(second),
    }
}
