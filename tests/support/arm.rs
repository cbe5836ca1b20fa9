//! Arms for tests: their joints, their motors, and how far two poses of a tip are apart.

#![allow(clippy::expect_used, reason = "what fails here fails a test")]
#![allow(dead_code, reason = "each program of tests uses a part of it")]

use rapid_core::rotation;
use rapid_motors::kinematics::Arm;
use rapid_registry::{CanProtocol, CanSpec, DamiaoSpec, NodeSpec, Registry};

pub(crate) const Y: &str = "0 1 0";
pub(crate) const Z: &str = "0 0 1";
/// Joints whose tip takes any pose near by, each with its place on the one before and its axis: as many as a pose has
/// coordinates, and one more, so that the elbow has a choice.
pub(crate) const SIX: [(&str, &str); 6] =
    [("0 0 0.2", Z), ("0 0 0.1", Y), ("0 0 0.4", Y), ("0 0 0.2", Z), ("0 0 0.2", Y), ("0 0 0.1", Z)];
pub(crate) const COMMANDED: &str = "rotation = \"commanded\"";

/// Motors of these joints and of a gripper, as a registry declares them.
pub(crate) fn declared(joints: &[&str], more: &str) -> DamiaoSpec {
    let motor = |(at, name): (usize, &&str)| {
        let slave = at + 1;
        format!("{{ name = \"{name}\", slave = {slave}, type = \"DM4310\", kp = 20, kd = 1, position = [-3, 3] }}")
    };
    let list: Vec<_> = joints.iter().chain(&["jaw"]).enumerate().map(motor).collect();
    let text = format!(
        "[device.arm]\nvid = \"1d50\"\npid = \"606f\"\nnode = \"can\"\nbit = 0\n[device.arm.can]\nprotocol = \"damiao\"\n\
         motors = [{}]\n[device.arm.effector]\nurdf = \"arm.urdf\"\ntip = \"tool\"\nmin = [-2, -2, 0]\nmax = [2, 2, 2]\n\
         gripper = \"jaw\"\nclosed = 0.0\nopen = 1.0\n{more}\n",
        list.join(", ")
    );
    let registry = Registry::parse(&text, None).unwrap_or_else(|error| panic!("{error}")).registry;
    match registry.devices.into_iter().next().expect("a device").node {
        NodeSpec::Can(CanSpec { protocol: CanProtocol::Damiao(motors), .. }) => motors,
        node => panic!("{node:?}"),
    }
}

/// An arm of these joints. It stands aslant and its tool is bent, so that no rotation is the same in two frames.
pub(crate) fn arm_of(joints: &[(&str, &str)], more: &str) -> Arm {
    let names: Vec<String> = (0..joints.len()).map(|at| format!("j{at}")).collect();
    let links: Vec<String> = (0..=joints.len()).map(|at| format!("<link name=\"l{at}\"/>")).collect();
    let joint = |(at, (place, axis)): (usize, &(&str, &str))| {
        let next = at + 1;
        format!(
            "<joint name=\"j{at}\" type=\"revolute\"><parent link=\"l{at}\"/><child link=\"l{next}\"/>\
             <origin xyz=\"{place}\" rpy=\"0 0 0\"/><axis xyz=\"{axis}\"/>\
             <limit lower=\"-2.9\" upper=\"2.9\" effort=\"10\" velocity=\"3\"/></joint>"
        )
    };
    let moving: Vec<String> = joints.iter().enumerate().map(joint).collect();
    let urdf = format!(
        "<?xml version=\"1.0\"?><robot name=\"any\"><link name=\"table\"/>{}<link name=\"tool\"/>\
         <joint name=\"mount\" type=\"fixed\"><parent link=\"table\"/><child link=\"l0\"/>\
         <origin xyz=\"0.1 -0.05 0.2\" rpy=\"0.1 -0.2 0.3\"/></joint>{}\
         <joint name=\"tool\" type=\"fixed\"><parent link=\"l{}\"/><child link=\"tool\"/>\
         <origin xyz=\"0.03 0.02 0.12\" rpy=\"0.3 -0.2 0.5\"/></joint></robot>",
        links.concat(),
        moving.concat(),
        joints.len()
    );
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    let motors = declared(&names, more);
    Arm::from_urdf(motors.effector.as_deref().expect("an effector"), &motors.motors, &urdf).expect("it fits")
}

/// A sample of the motors at these positions.
pub(crate) fn sample(positions: &[f64]) -> Vec<f64> {
    positions.iter().flat_map(|position| [*position, 0.0, 0.0, 0.0, 0.0, 0.0]).collect()
}

pub(crate) fn distance(one: &[f64], other: &[f64]) -> f64 {
    one.iter().zip(other).map(|(one, other)| (one - other).powi(2)).sum::<f64>().sqrt()
}

/// How far two poses are apart: m, and rad; without the angle about z if that is free.
pub(crate) fn apart(one: &[f64], other: &[f64], free_yaw: bool) -> [f64; 2] {
    let [qx, qy, qz, qw] = [4, 5, 6, 7].map(|at| other[at]);
    let [x, y, z, w] = rotation::product([4, 5, 6, 7].map(|at| one[at]), [-qx, -qy, -qz, qw]);
    // A rotation about z, then one about an axis across it: the half angle of the second is that of x and y alone.
    let half = if free_yaw { x.hypot(y).atan2(z.hypot(w)) } else { x.hypot(y).hypot(z).atan2(w.abs()) };
    [distance(&one[..3], &other[..3]), 2.0 * half]
}
