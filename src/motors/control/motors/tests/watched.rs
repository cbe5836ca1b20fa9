//! What motors report and do, and should not: first a word, then a fault, and no command that follows it.

use std::f64::consts::TAU;

use rapid_registry::MotorSpec;

use super::world::CYCLE;
use super::*;
use crate::control::damiao::parameter::{Parameter, Value};

/// One motor that is armed, changed by `change` before.
fn armed(change: impl Fn(&mut MotorSpec)) -> World {
    let mut joint = motor(1, 0x11, MIT);
    (joint.torque, joint.velocity) = (1.0, 2.0);
    change(&mut joint);
    let mut world = World::new(spec(vec![joint]));
    world.run_until(BusState::Disarmed);
    world.arm();
    world.run_until(BusState::Holding);
    world
}

/// Runs this many cycles with actions to `target`; returns the fault and the cycle in which it occurred.
fn fault_within(world: &mut World, target: f64, cycles: usize) -> Option<(Fault, usize)> {
    for cycle in 1..=cycles {
        if cycle % 20 == 1 {
            world.target(&[target]);
        }
        world.cycle();
        if let BusState::Faulted(fault) = world.bus.state() {
            return Some((fault, cycle));
        }
    }
    None
}

fn words(world: &World) -> Vec<String> {
    let strange = world.notices.iter().filter(|notice| matches!(notice, Notice::Strange { .. }));
    strange.map(|notice| notice.words(world.bus.names()).to_string()).collect()
}

#[test]
fn one_wrong_position_moves_nothing_and_three_are_a_fault() {
    for (wrong, by) in [(1, TAU), (2, -TAU), (1, 0.2), (3, TAU), (3, -0.2)] {
        let mut world = armed(|_| {});
        assert_eq!(fault_within(&mut world, 1.0, 40), None);
        for _ in 0..wrong {
            let mut sim = world.sims[0].clone();
            sim.q += by;
            // Behind the right one of the same cycle, which is 5 ms old by then.
            world.now = world.now.after(CYCLE / 2);
            world.feed(&sim.feedback().unwrap(), world.now);
        }
        let fault = fault_within(&mut world, 1.0, 40);
        assert_eq!(fault.is_some(), wrong == 3, "{wrong} by {by}: {fault:?}");
        let jumps = words(&world).iter().filter(|word| word.contains("joint_1 reports")).count();
        assert_eq!(jumps, 1, "{wrong} by {by}: {:?}", words(&world));
    }
}

#[test]
fn an_arm_outside_the_limits_is_refused_with_where_the_joint_is() {
    for (q, may) in [(2.05, true), (2.15, false), (-2.05, true), (-6.77, false)] {
        let mut world = World::ready();
        world.sims[0].q = q;
        world.run(2);
        world.arm();
        if may {
            world.run_until(BusState::Holding);
            continue;
        }
        let fault = world.run_to_fault();
        assert!(matches!(fault, Fault::Strange { motor: 0, what: Strange::Beyond { .. } }), "{fault:?}");
        let text = fault.words(world.bus.names()).to_string();
        assert!(text.contains("outside its limits of -2 to 2 rad"), "{text}");
        assert!(!world.sims.iter().any(Sim::is_on));
        // Led back, it may.
        world.sims[0].q = 0.0;
        world.run(2);
        world.arm();
        world.run_until(BusState::Holding);
    }
}

/// What happens to a motor, the most cycles until it is a fault, and the name of the fault.
type Trouble = (&'static str, fn(&mut World), std::ops::RangeInclusive<usize>, &'static str);

#[test]
fn a_persistent_condition_causes_a_warning_and_then_a_named_fault() {
    const TROUBLES: [Trouble; 6] = [
        ("it sinks", |world| (world.sims[0].stuck, world.sims[0].drift) = (true, -0.77), 40..=80, "moves away from"),
        ("it is blocked", |world| world.sims[0].stuck = true, 400..=450, "does not move at its torque limit of 1 Nm"),
        ("its encoder is frozen", |world| world.sims[0].stuck = true, 400..=450, "does not move"),
        (
            "it is pushed out",
            |world| (world.sims[0].stuck, world.sims[0].drift) = (true, 10.0),
            4..=70,
            "outside its limits",
        ),
        ("it is too fast", |world| (world.sims[0].stuck, world.sims[0].drift) = (true, 3.9), 20..=23, "moves at 3."),
        ("it is too strong", |world| world.sims[0].tau = 6.0, 20..=24, "reports 6.0"),
    ];
    for (what, trouble, cycles, name) in TROUBLES {
        let mut world = armed(|joint| {
            joint.velocity = if what == "it is pushed out" { 20.0 } else { 2.0 };
        });
        assert_eq!(fault_within(&mut world, 0.25, 20), None, "{what}");
        trouble(&mut world);
        let (fault, cycle) = fault_within(&mut world, 1.5, 500).unwrap_or_else(|| panic!("{what}: no fault"));
        let text = fault.words(world.bus.names()).to_string();
        assert!(text.contains(name) && cycles.contains(&cycle), "{what}: {text} after {cycle} cycles");
        assert!(
            words(&world).iter().any(|word| word.contains(name.split(" with").next().unwrap())),
            "{what}: {:?}",
            words(&world)
        );
    }
}

#[test]
fn a_blocked_joint_is_a_fault_even_if_actions_arrive_during_a_step() {
    let mut world = armed(|_| {});
    world.sims[0].stuck = true;
    let begun = world.now;
    let fault = (0..500).find_map(|cycle| {
        if cycle % 20 == 0 {
            // As the thread that drives the bus does it: with the time of the step.
            let now = world.now.after(CYCLE);
            world.bus.target(&[1.5], now, now);
        }
        world.cycle();
        matches!(world.bus.state(), BusState::Faulted(_)).then_some(world.now)
    });
    let lasted = fault.expect("a fault").since(begun);
    assert!((2000..2200).contains(&lasted.as_millis()), "{lasted:?}");
    assert_eq!(words(&world).len(), 1, "{:?}", words(&world));
}

#[test]
fn repeats_within_a_second_are_not_reported_again() {
    let mut world = armed(|joint| (joint.watch.blocked_after, joint.velocity) = (None, 5.0));
    for (cycles, stuck) in [(40, true), (40, false), (40, true), (200, false), (60, true)] {
        world.sims[0].stuck = stuck;
        assert_eq!(fault_within(&mut world, if stuck { 1.5 } else { 0.25 }, cycles), None);
    }
    let blocked = words(&world).iter().filter(|word| word.contains("does not move")).count();
    assert_eq!(blocked, 2, "{:?}", words(&world));
}

#[test]
fn a_speed_without_a_movement_is_a_frozen_encoder() {
    for mode in [MIT, MotorMode::PositionVelocity, MotorMode::Velocity] {
        let mut world = armed(|joint| joint.mode = mode);
        assert_eq!(fault_within(&mut world, 0.25, 20), None);
        let mut sim = world.sims[0].clone();
        (sim.dq, sim.status) = (1.2, MotorStatus::Enabled);
        let frozen = sim.feedback().unwrap();
        world.sims[0].silent = true;
        let begun = world.now;
        for cycle in 1..=40 {
            world.now = world.now.after(CYCLE);
            world.bus.feed(&frozen, world.now);
            world.bus.step(world.now, |_| {});
            while let Some(notice) = world.bus.take_notice() {
                world.notices.push(notice);
            }
            let report = words(&world).iter().filter(|word| word.contains("encoder stands still")).count();
            assert_eq!(report, usize::from(cycle >= 7), "{mode:?}: {cycle} cycles, {:?}", words(&world));
            if let BusState::Faulted(fault) = world.bus.state() {
                let after = world.now.since(begun).as_millis();
                assert!(matches!(fault, Fault::Strange { what: Strange::Frozen { .. }, .. }), "{fault:?}");
                assert!((90..=120).contains(&after), "{after} ms");
                break;
            }
        }
        assert!(matches!(world.bus.state(), BusState::Faulted(_)), "{mode:?}");
    }
}

#[test]
fn a_gripper_may_hold_something_forever() {
    let mut world = armed(|joint| joint.watch.blocked_after = None);
    world.sims[0].stuck = true;
    assert_eq!(fault_within(&mut world, 1.5, 2000), None);
    assert_eq!(words(&world).len(), 1, "{:?}", words(&world));
}

#[test]
fn a_motor_whose_own_loop_misses_its_target_is_a_fault() {
    for (mode, target) in [(MotorMode::PositionVelocity, 1.5), (MotorMode::Velocity, 9.0)] {
        let mut world = armed(|joint| joint.mode = mode);
        world.sims[0].stuck = true;
        let (fault, _) = fault_within(&mut world, target, 400).unwrap_or_else(|| panic!("{mode:?}"));
        assert!(matches!(fault, Fault::Strange { what: Strange::Lagging { .. }, .. }), "{fault:?}");
    }
}

#[test]
fn a_change_by_another_program_is_noticed_within_a_second() {
    for change in [|sim: &mut Sim| sim.timeout = 0, |sim: &mut Sim| sim.mode = 3] {
        let mut world = armed(|_| {});
        assert_eq!(fault_within(&mut world, 0.25, 400), None);
        change(&mut world.sims[0]);
        let (fault, cycle) = fault_within(&mut world, 0.25, 400).expect("a fault");
        assert!(matches!(fault, Fault::Changed { motor: 0, .. }) && cycle <= 200, "{fault:?} after {cycle} cycles");
        let text = fault.words(world.bus.names()).to_string();
        assert!(text.ends_with("now: another program set it"), "{text}");
        // The next arm sets it right.
        world.arm();
        world.run_until(BusState::Holding);
    }
}

#[test]
fn a_changed_range_is_noticed_in_the_reply_to_another_program() {
    for (parameter, value) in [(Parameter::PMax, 25.0), (Parameter::VMax, 10.0), (Parameter::TMax, 28.0)] {
        let mut world = armed(|_| {});
        assert_eq!(fault_within(&mut world, 0.25, 20), None);
        let same = Reply { slave: 1, written: true, parameter: Parameter::PMax, value: Value::Float(12.5) };
        world.bus.feed(&same.encode(0x11), world.now);
        assert_eq!(fault_within(&mut world, 0.25, 1), None, "the same as before");
        let reply = Reply { value: Value::Float(value), parameter, ..same };
        world.bus.feed(&reply.encode(0x11), world.now);
        let (fault, _) = fault_within(&mut world, 0.25, 1).expect("a fault");
        assert!(matches!(fault, Fault::Changed { motor: 0, .. }), "{fault:?}");
    }
}

#[test]
fn another_master_is_named_and_nothing_is_armed_beside_it() {
    let commands = [
        StateCommand::Enable.frame(1),
        StateCommand::Disable.frame(1),
        StateCommand::SetZero.frame(1),
        codec::velocity(1, 0.0).unwrap(),
    ];
    for command in commands {
        let mut world = armed(|_| {});
        assert_eq!(fault_within(&mut world, 0.25, 20), None);
        world.bus.feed(&command, world.now);
        let (fault, cycle) = fault_within(&mut world, 0.25, 20).expect("a fault");
        assert_eq!((fault, cycle), (Fault::OtherMaster { motor: 0 }, 1));
        // It continues to command: no arm.
        for _ in 0..5 {
            world.bus.feed(&command, world.now);
            world.arm();
            world.run(20);
            world.bus.feed(&command, world.now);
            assert_eq!(world.run_to_fault(), Fault::OtherMaster { motor: 0 });
            assert!(!world.sims[0].is_on());
        }
        world.run(200);
        world.arm();
        world.run_until(BusState::Holding);
    }
}
