//! `[device.NAME.pose]`, `[device.NAME.joints]`, `[device.NAME.calibration]` and `[device.NAME.points]`, and the forms that
//! follow from the device itself.

use rapid_core::modality::ModalityKind;
use rapid_core::points::PacketFormat;

use crate::keys::{Key, NUMBERS, Own, TEXT, TEXTS, Words, keys, texts};
use crate::section::Section;
use crate::spec::{
    CalibrationSpec, CanProtocol, CanSpec, Form, JointsSpec, LanProtocol, LanSpec, NodeSpec, PhoneStream, PointsSpec,
    PoseLayout, PoseSpec, Quantity, TipForm,
};

const POSE: &str = "pose";
const JOINTS: &str = "joints";
const CALIBRATION: &str = "calibration";
const POINTS: &str = "points";
const WORLD: &str = "world";
/// The keys of the table of a pose.
pub(super) const POSE_KEYS: [&[Key]; 2] = [PoseKeys::KEYS, FrameKeys::KEYS];
/// Models of a lens that viewers know, each with its name and how many parameters it has.
const MODELS: [(&str, (&str, usize)); 3] = [
    ("plumb_bob", ("plumb_bob", 5)),
    ("rational_polynomial", ("rational_polynomial", 8)),
    ("kannala_brandt", ("kannala_brandt", 4)),
];

keys! {
    /// `[device.NAME.pose]`: the pose of a frame that has the name of the entry.
    pub(super) struct PoseKeys {
        /// The order of its values.
        layout: Option<PoseLayout> = Words(&PoseLayout::WORDS), usually "needed, but for a phone";
    }

    /// The frame of a pose.
    pub(super) struct FrameKeys {
        /// The frame in which the pose is given.
        parent: Option<String> = TEXT, usually "`\"world\"`";
    }

    /// `[device.NAME.joints]`.
    pub(super) struct JointsKeys {
        /// Names of the joints, as in the robot's description.
        names: Option<Vec<String>> = TEXTS, need "write names = [\"shoulder\", \"elbow\"], as in the robot's description";
        /// What the values of each joint are, in order: `"position"`, `"velocity"`, `"effort"`, `"other"`.
        quantities: Option<Vec<Quantity>> = QUANTITIES, usually "`[\"position\"]`";
    }

    /// `[device.NAME.calibration]`.
    pub(super) struct CalibrationKeys {
        /// Model of the lens.
        model: Option<(&'static str, usize)> = Words(&MODELS), usually "`\"plumb_bob\"`";
        /// Its parameters: as many as the model has, or none.
        distortion: Option<Vec<f64>> = NUMBERS, usually "none";
        /// `[fx, 0, cx, 0, fy, cy, 0, 0, 1]`, row by row, in pixels of the pictures as they are recorded.
        intrinsics: Option<Vec<f64>> = NUMBERS, need "write intrinsics = [fx, 0, cx, 0, fy, cy, 0, 0, 1], in pixels";
    }

    /// `[device.NAME.points]`.
    pub(super) struct PointsKeys {
        /// The format of its packets.
        format: Option<PacketFormat> = Words(&PacketFormat::WORDS), need "write format = \"velodyne\" or \"livox\"";
        /// The frame in which points are given.
        frame: Option<String> = TEXT, usually "the name of the entry";
    }
}

const QUANTITIES: Own<Vec<Quantity>> = texts(quantities, "a list of these words");
/// Of a motor: `control::motors::SAMPLE_VALUES`.
const OF_A_MOTOR: [Quantity; 6] =
    [Quantity::Position, Quantity::Velocity, Quantity::Effort, Quantity::Other, Quantity::Other, Quantity::Other];

/// The form of the samples of the entry `name`, of which each has `count` numbers; `None` if they have none, or if a problem was
/// reported.
pub(super) fn form(name: &str, section: &Section<'_>, node: Option<&NodeSpec>, count: Option<usize>) -> Option<Form> {
    if let Some(node) = node
        && let Some(own) = of_node(node)
    {
        refuse_tables(section, &own);
        return Some(match (own, section.table(POSE)) {
            (Form::Pose(own), Some(table)) => {
                table.known(&[FrameKeys::KEYS]);
                Form::Pose(PoseSpec { parent: parent(&table, name), ..own })
            }
            (own, _) => own,
        });
    }
    if let Some(table) = section.table(CALIBRATION) {
        return calibration(section, &table, node?).map(Form::Calibration);
    }
    if let Some(table) = section.table(POINTS) {
        return points(name, section, &table, node?).map(Form::Points);
    }
    let (form, key) = match (section.table(POSE), section.table(JOINTS)) {
        (Some(_), Some(_)) => {
            let message = "its numbers are a pose or the states of joints, not both".to_owned();
            return section.refuse(JOINTS, message, "remove one of the two tables");
        }
        (Some(table), None) => (Form::Pose(pose(name, &table)?), POSE),
        (None, Some(table)) => (Form::Joints(joints(&table)?), JOINTS),
        (None, None) => return None,
    };
    // The number of numbers is wrong too, if the node is.
    let count = count?;
    if count == form.numbers() {
        return Some(form);
    }
    if count == 0 {
        return section.refuse(key, "its samples are not numbers".to_owned(), "remove the table");
    }
    let message = format!("{} values for a sample of {count}", form.numbers());
    let fix = match &form {
        Form::Pose(_) => "columns and rows have 16 values, a quaternion with its position 7: write as many `channels`",
        Form::Joints(_) | Form::Calibration(_) | Form::Points(_) => {
            "a sample has each of `quantities` for each of `names`: write as many `channels`"
        }
    };
    section.refuse(key, message, fix)
}

/// What a device of known contents sends.
fn of_node(node: &NodeSpec) -> Option<Form> {
    match node {
        NodeSpec::Can(CanSpec { protocol: CanProtocol::Damiao(damiao), .. }) => Some(Form::Joints(JointsSpec {
            names: damiao.motors.iter().map(|motor| motor.name.clone()).collect(),
            quantities: OF_A_MOTOR.to_vec(),
            tip: damiao.effector.as_ref().map(|effector| TipForm {
                parent: effector.frame.clone().unwrap_or_else(|| WORLD.to_owned()),
                has_opening: effector.gripper.is_some(),
            }),
        })),
        NodeSpec::Lan(LanSpec { protocol: LanProtocol::Iphone { stream: PhoneStream::Pose, .. }, .. }) => {
            Some(Form::Pose(PoseSpec { layout: PoseLayout::Columns, parent: WORLD.to_owned() }))
        }
        _ => None,
    }
}

/// Reports the tables that a device of known contents does not take.
fn refuse_tables(section: &Section<'_>, own: &Form) {
    let (tables, what): (&[&str], _) = match own {
        Form::Pose(_) => (&[JOINTS, CALIBRATION, POINTS], "sends the pose of its camera"),
        Form::Joints(_) | Form::Calibration(_) | Form::Points(_) => {
            (&[POSE, JOINTS, CALIBRATION, POINTS], "sends the states of its motors, with their names")
        }
    };
    for table in tables.iter().filter(|table| section.has(table)) {
        section.report(table, format!("the device {what}"), "remove the table");
    }
}

fn calibration(section: &Section<'_>, table: &Section<'_>, node: &NodeSpec) -> Option<CalibrationSpec> {
    let keys = CalibrationKeys::read(table);
    let size = node.shape();
    let (ModalityKind::Image | ModalityKind::Depth, [height, width]) = (node.modality_kind(), &size[..]) else {
        return section.refuse(CALIBRATION, "its samples are not pictures".to_owned(), "remove the table");
    };
    refuse_others(section, &[POSE, JOINTS, POINTS], "its samples are pictures");
    let distortion = if table.has("distortion") { keys.distortion? } else { Vec::new() };
    let intrinsics = keys.intrinsics?;
    let Ok(intrinsics) = <[f64; 9]>::try_from(intrinsics.as_slice()) else {
        let message = format!("{} values, and the matrix has 9", intrinsics.len());
        return table.refuse("intrinsics", message, "write [fx, 0, cx, 0, fy, cy, 0, 0, 1], in pixels");
    };
    let is_matrix = intrinsics.iter().all(|number| number.is_finite()) && intrinsics[0] > 0.0 && intrinsics[4] > 0.0;
    if !is_matrix || intrinsics[6..] != [0.0, 0.0, 1.0] {
        let fix = "write [fx, 0, cx, 0, fy, cy, 0, 0, 1], row by row, in pixels of the pictures as they are recorded";
        return table.refuse("intrinsics", "not the matrix of a camera".to_owned(), fix);
    }
    let (model, parameters) = if table.has("model") { keys.model? } else { ("plumb_bob", 5) };
    if !distortion.is_empty() && distortion.len() != parameters {
        let message = format!("{} values, and {model} has {parameters}", distortion.len());
        return table.refuse("distortion", message, "write those of the calibration, or name its `model`");
    }
    if distortion.iter().any(|number| !number.is_finite()) {
        return table.refuse("distortion", "a number that is not finite".to_owned(), "write those of the calibration");
    }
    Some(CalibrationSpec { width: *width, height: *height, model: model.to_owned(), distortion, intrinsics })
}

fn points(name: &str, section: &Section<'_>, table: &Section<'_>, node: &NodeSpec) -> Option<PointsSpec> {
    let keys = PointsKeys::read(table);
    if node.modality_kind() != ModalityKind::Bytes {
        return section.refuse(POINTS, "its samples are not packets".to_owned(), "remove the table");
    }
    refuse_others(section, &[POSE, JOINTS], "its samples are packets");
    let frame = match keys.frame {
        Some(frame) if frame.is_empty() => {
            let fix = "write frame = \"base\", or remove the key: the frame has the name of the entry then";
            return table.refuse("frame", "the frame has no name".to_owned(), fix);
        }
        frame => frame.unwrap_or_else(|| name.to_owned()),
    };
    Some(PointsSpec { format: keys.format?, frame })
}

fn refuse_others(section: &Section<'_>, others: &[&str], why: &str) {
    for other in others.iter().filter(|other| section.has(other)) {
        section.report(other, why, "remove the table");
    }
}

fn parent(table: &Section<'_>, name: &str) -> String {
    match FrameKeys::values(table).parent {
        Some(parent) if parent.is_empty() => {
            table.report("parent", "the frame has no name", "write parent = \"world\", or remove the key");
            String::new()
        }
        Some(parent) if parent == name => {
            table.report("parent", "the frame of the entry itself", "name another frame, such as \"world\"");
            String::new()
        }
        parent => parent.unwrap_or_else(|| WORLD.to_owned()),
    }
}

fn pose(name: &str, table: &Section<'_>) -> Option<PoseSpec> {
    table.known(&POSE_KEYS);
    table.need("layout", "write layout = \"quaternion\", \"columns\" or \"rows\"");
    let (keys, parent) = (PoseKeys::values(table), parent(table, name));
    Some(PoseSpec { layout: keys.layout?, parent })
}

fn joints(table: &Section<'_>) -> Option<JointsSpec> {
    let JointsKeys { names, quantities } = JointsKeys::read(table);
    let quantities = if table.has("quantities") { quantities } else { Some(vec![Quantity::Position]) };
    let (names, quantities) = (names?, quantities?);
    let twice = names.iter().enumerate().find(|(at, name)| names.iter().take(*at).any(|earlier| earlier == *name));
    if names.is_empty() {
        return table.refuse("names", "no joints are named".to_owned(), "name every joint, or remove the table");
    }
    if names.iter().any(String::is_empty) {
        return table.refuse("names", "a joint without a name".to_owned(), "name every joint");
    }
    if let Some((_, name)) = twice {
        return table.refuse("names", format!("joint {name:?} is in the list twice"), "name it once");
    }
    Some(JointsSpec { names, quantities, tip: None })
}

fn quantities(table: &Section<'_>, key: &str) -> Option<Vec<Quantity>> {
    const FIX: &str =
        "write each of \"position\", \"velocity\" and \"effort\" at most once, and \"other\" for the rest";
    let mut found = Vec::new();
    for word in table.texts(key)? {
        let Some((_, quantity)) = Quantity::WORDS.iter().find(|(known, _)| *known == word) else {
            return table.refuse(key, format!("unknown quantity {word:?}"), FIX);
        };
        if *quantity != Quantity::Other && found.contains(quantity) {
            return table.refuse(key, format!("{word:?} is in the list twice"), FIX);
        }
        found.push(*quantity);
    }
    if found.iter().all(|quantity| *quantity == Quantity::Other) {
        return table.refuse(key, "none of them is a state of a joint".to_owned(), FIX);
    }
    Some(found)
}
