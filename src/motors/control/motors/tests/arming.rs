//! Arming, and what ends it.

use super::*;
use crate::control::damiao::codec::StateCommand;

#[test]
fn an_arm_starts_where_the_joints_are() {
    let mut world = World::ready();
    (world.sims[0].q, world.sims[1].q) = (1.5, -0.75);
    world.arm();
    world.run_until(BusState::Holding);
    assert!(world.sims.iter().all(Sim::is_on));
    world.run(20);
    assert!((world.sims[0].q - 1.5).abs() < 1e-3 && (world.sims[1].q + 0.75).abs() < 1e-3);
    assert_eq!((world.notified(Notice::Arming), world.notified(Notice::Armed)), (1, 1));
    // Once more is nothing new.
    world.arm();
    world.cycle();
    assert_eq!((world.bus.state(), world.notified(Notice::Arming)), (BusState::Holding, 1));
}

#[test]
fn an_arm_at_the_start_takes_effect() {
    let mut world = World::new(spec(vec![motor(1, 0x11, MIT)]));
    world.arm();
    world.run_until(BusState::Holding);
}

#[test]
fn an_arm_clears_a_fault_and_fails_while_it_lasts() {
    let mut world = World::ready();
    world.sims[1].status = MotorStatus::CommunicationLost;
    let fault = Fault::Latched { motor: 1, status: MotorStatus::CommunicationLost };
    assert_eq!(world.run_to_fault(), fault);
    world.run(500);
    assert_eq!(world.bus.state(), BusState::Faulted(fault), "only an arm brings it back");
    world.arm();
    world.run_until(BusState::Holding);
    let cleared = Notice::Cleared { motor: 1, status: MotorStatus::CommunicationLost };
    assert_eq!(world.notified(cleared), 1, "{:?}", world.notices);
    world.disarm();
    world.run_until(BusState::Disarmed);

    world.sims[1].status = MotorStatus::UnderVoltage;
    world.sims[1].broken = Some(MotorStatus::UnderVoltage);
    let fault = world.run_to_fault();
    for _ in 0..2 {
        world.arm();
        world.cycle();
        assert_eq!(world.bus.state(), BusState::Arming);
        assert_eq!(world.run_to_fault(), fault);
        assert!(!world.sims[0].is_on());
    }
    world.sims[1].broken = None;
    world.arm();
    world.run_until(BusState::Holding);
}

#[test]
fn a_silent_motor_disables_all_and_an_arm_fails_until_it_answers() {
    let mut world = World::armed();
    world.sims[1].silent = true;
    assert_eq!(world.run_to_fault(), Fault::Silent { motor: 1 });
    world.run(2);
    assert!(!world.sims[0].is_on() && !world.moved());
    world.arm();
    assert_eq!(world.run_to_fault(), Fault::Silent { motor: 1 });
    // It is ordered to turn off all the while: it may receive although its own frames do not arrive.
    world.cycle();
    assert!(world.sent.contains(&StateCommand::Disable.frame(2)));
    world.sims[1].silent = false;
    world.run(5);
    assert!(!world.sims[1].is_on());
    assert_eq!(world.bus.state(), BusState::Faulted(Fault::Silent { motor: 1 }));
    world.arm();
    world.run_until(BusState::Holding);
}

#[test]
fn a_few_lost_answers_do_not_count_as_silence() {
    let mut world = World::armed();
    for _ in 0..15 {
        world.sims[1].silent = true;
        world.run(7);
        world.sims[1].silent = false;
        world.run(1);
    }
    assert_eq!(world.bus.state(), BusState::Holding);
}

#[test]
fn a_motor_is_set_up_again_after_a_power_interruption() {
    let mut world = World::armed();
    world.sims[0].status = MotorStatus::Disabled;
    (world.sims[0].mode, world.sims[0].timeout) = (2, 0);
    assert_eq!(world.run_to_fault(), Fault::Dropped { motor: 0 });
    world.run(3);
    assert!(!world.sims[1].is_on());
    world.arm();
    world.run_until(BusState::Holding);
    assert_eq!((world.sims[0].mode, world.sims[0].timeout), (1, 8000));
}

#[test]
fn every_fault_of_a_motor_that_moves_disables_all() {
    for code in (2..16).chain([0]) {
        let mut world = World::armed();
        world.target(&[1.0, 1.0]);
        world.run(3);
        let status = MotorStatus::from_code(code);
        world.sims[0].status = status;
        world.cycle();
        world.cycle();
        let fault = world.run_to_fault();
        let expected = if code == 0 { Fault::Dropped { motor: 0 } } else { Fault::Latched { motor: 0, status } };
        assert_eq!(fault, expected);
        world.run(2);
        assert!(!world.sims[1].is_on());
    }
}

#[test]
fn a_fault_between_two_cycles_is_not_masked_by_later_frames() {
    for (status, hot) in [(MotorStatus::Disabled, 30), (MotorStatus::Overload, 30), (MotorStatus::Enabled, 90)] {
        let mut world = World::armed();
        world.run(2);
        let well = world.sims[0].feedback().unwrap();
        let ill = Sim { status, mos: hot, ..world.sims[0].clone() }.feedback().unwrap();
        for frame in [well, ill, well] {
            world.bus.feed(&frame, world.now);
        }
        assert!(matches!(world.bus.state(), BusState::Faulted(_)), "{status}");
    }
}

#[test]
fn an_overheating_motor_is_reported_and_then_disables_all() {
    let mut world = World::armed();
    let warm = |celsius| Notice::Warm { motor: 0, part: Part::Mos, celsius, limit: 80.0 };
    for (mos, reported) in [(69, 0), (70, 1), (68, 1), (75, 1), (64, 1), (71, 2), (79, 2)] {
        world.sims[0].mos = mos;
        world.run(3);
        assert_eq!(
            world.notices.iter().filter(|notice| matches!(notice, Notice::Warm { .. })).count(),
            reported,
            "{mos}"
        );
    }
    assert_eq!((world.notified(warm(70.0)), world.notified(warm(71.0))), (1, 1));
    world.sims[0].rotor = 100;
    assert_eq!(world.run_to_fault(), Fault::Hot { motor: 0, part: Part::Rotor, celsius: 100.0, limit: 100.0 });
    world.run(2);
    assert!(!world.sims.iter().any(Sim::is_on));
    world.arm();
    world.run(3);
    assert!(matches!(world.bus.state(), BusState::Faulted(Fault::Hot { .. })));
    world.sims[0].rotor = 90;
    world.run(3);
    world.arm();
    world.run_until(BusState::Holding);
}

#[test]
fn a_motor_that_ignores_commands_is_a_fault() {
    let mut world = World::ready();
    world.sims[1].deaf = Some(StateCommand::Enable);
    world.arm();
    assert_eq!(world.run_to_fault(), Fault::NotEnabled { motor: 1 });
    world.sims[1].deaf = None;
    world.arm();
    world.run_until(BusState::Holding);
    world.sims[1].deaf = Some(StateCommand::Disable);
    world.disarm();
    assert_eq!(world.run_to_fault(), Fault::NotDisabled { motor: 1 });
    world.arm();
    assert_eq!(world.run_to_fault(), Fault::NotDisabled { motor: 1 });
    world.cycle();
    assert!(world.sent.contains(&StateCommand::Disable.frame(2)));
}

#[test]
fn a_joint_waiting_for_the_others_yields_to_external_force() {
    let mut stiff = spec(vec![motor(1, 0x11, MIT), motor(2, 0x12, MIT)]);
    stiff.motors[0].torque = 2.0;
    let mut world = World::new(stiff);
    world.run_until(BusState::Disarmed);
    world.sims[0].stuck = true;
    world.sims[1].deaf = Some(StateCommand::Enable);
    world.arm();
    while world.sims[0].command.is_none() {
        world.cycle();
    }
    world.run(5);
    for _ in 0..30 {
        world.sims[0].q += 0.025;
        world.cycle();
    }
    world.run(10);
    assert_eq!(world.bus.state(), BusState::Arming);
    let command = world.sims[0].command.unwrap().1;
    assert!((command - 0.8).abs() < 1e-3, "{command}: 2 Nm at 10 Nm/rad are 0.2 rad, and it is at 1.0");
}

#[test]
fn a_disarm_ends_an_arm_at_any_moment() {
    for cycles in 0..30 {
        let mut world = World::ready();
        world.arm();
        world.run(cycles);
        world.disarm();
        world.run_until(BusState::Disarmed);
        world.run(5);
        assert!(!world.sims.iter().any(Sim::is_on), "{cycles}");
        assert_eq!(world.notified(Notice::Disabled(Reason::Asked)), 1);
        world.arm();
        world.run_until(BusState::Holding);
    }
}

#[test]
fn a_motor_counts_as_off_when_it_confirms_after_the_order() {
    let enabling = || {
        let mut world = World::ready();
        world.sims[0].deaf = Some(StateCommand::Enable);
        world.arm();
        while !world.sent.contains(&StateCommand::Enable.frame(1)) {
            world.cycle();
        }
        world
    };
    // An earlier report is not an answer to the order, which is still sent.
    let mut world = enabling();
    world.disarm();
    let before = world.sims[0].feedback().unwrap();
    world.bus.feed(&before, world.now);
    world.cycle();
    assert!(world.sent.contains(&StateCommand::Disable.frame(1)));
    // Nor is silence one.
    let mut world = enabling();
    world.cycle();
    world.disarm();
    world.sims[0].silent = true;
    world.latency = 0;
    world.run(1);
    world.disarm();
    assert_eq!(world.run_to_fault(), Fault::Silent { motor: 0 });
    assert_eq!(world.notified(Notice::Disabled(Reason::Asked)), 0);
}

#[test]
fn an_arm_while_motors_are_disabled_waits_for_that() {
    let mut world = World::armed();
    world.disarm();
    world.arm();
    world.run_until(BusState::Holding);
    assert_eq!(world.notified(Notice::Armed), 2);
}

#[test]
fn nothing_is_sent_after_a_stop() {
    for cycles in 0..25 {
        let mut world = World::ready();
        world.arm();
        world.run(cycles);
        assert_eq!(world.stop(), [StateCommand::Disable.frame(1), StateCommand::Disable.frame(2)]);
        assert_eq!(world.bus.state(), BusState::Stopped);
        world.arm();
        world.target(&[0.0, 0.0]);
        world.disarm();
        world.run(20);
        assert_eq!(world.sent, []);
        // The frames may be had as often as they are wanted.
        assert_eq!(world.stop().len(), 2);
    }
}

#[test]
fn late_motors_appear_in_samples_after_a_fault_or_a_disarm() {
    let mut sample = [0.0; 12];
    // Armed before the second one had power: the arm fails.
    let mut world = World::new(spec(vec![motor(1, 0x11, MIT), motor(2, 0x12, MIT)]));
    world.sims[1].silent = true;
    world.arm();
    let fault = world.run_to_fault();
    assert_eq!(fault, Fault::Silent { motor: 1 });
    world.run(200);
    assert_eq!(world.bus.sample(&mut sample), None);
    // Off again while it is asked: it is ordered to turn off, since it may receive.
    world.sims[1].silent = false;
    world.run(4);
    world.sims[1].silent = true;
    world.run(20);
    assert!(world.sent.contains(&StateCommand::Disable.frame(2)));
    world.sims[1].silent = false;
    world.run(30);
    assert!(world.bus.sample(&mut sample).is_some());
    assert!((sample[0] - 0.25).abs() < 1e-3 && (sample[6] - 0.25).abs() < 1e-3, "{sample:?}");
    assert_eq!(world.bus.state(), BusState::Faulted(fault), "only an arm brings it back");
    world.arm();
    world.run_until(BusState::Holding);

    // Disarmed during its first arm, at any moment.
    for cycles in 0..20 {
        let mut world = World::new(spec(vec![motor(1, 0x11, MIT), motor(2, 0x12, MIT)]));
        world.arm();
        world.run(cycles);
        world.disarm();
        world.run_until(BusState::Disarmed);
        world.run(40);
        assert!(world.bus.sample(&mut sample).is_some(), "{cycles}");
        assert!(!world.moved());
    }
}

#[test]
fn a_motor_with_unusable_parameters_is_not_queried_forever() {
    let mut world = World::new(spec(vec![motor(1, 0x11, MIT)]));
    (world.sims[0].mode, world.sims[0].stubborn) = (2, true);
    world.run_to_fault();
    world.run(500);
    assert_eq!(world.notices.iter().filter(|notice| matches!(notice, Notice::Fault(_))).count(), 1);
}

#[test]
fn positions_beyond_the_range_of_the_motor_are_a_fault() {
    for mode in [MIT, MotorMode::PositionVelocity, MotorMode::Velocity] {
        for position in [[13.0, 14.0], [-20.0, -12.6]] {
            let mut spec = spec(vec![motor(1, 0x11, mode)]);
            spec.motors[0].position = position;
            let mut world = World::new(spec);
            world.arm();
            let fault = world.run_to_fault();
            let expected = Fault::Unusable { motor: 0, parameter: Parameter::PMax, value: Value::Float(12.5) };
            assert_eq!(fault, expected, "{position:?}");
            let text = fault.words(world.bus.names()).to_string();
            assert_eq!(text, "motor joint_1 reports at most 12.5 rad, and its `position` lies beyond that");
        }
    }
}

#[test]
fn motors_that_may_be_on_are_known_after_a_stop() {
    let still_on = |world: &World| world.bus.still_on().map(str::to_owned).collect::<Vec<_>>();
    let mut world = World::armed();
    assert_eq!(still_on(&world), ["joint_1", "joint_2"]);
    // One of them has no power; the other's report of before is no answer.
    world.sims[1].silent = true;
    let before = world.sims[0].feedback().unwrap();
    let frames = world.stop();
    world.feed(&before, world.now);
    assert_eq!(still_on(&world), ["joint_1", "joint_2"]);
    for _ in 0..2 {
        for frame in &frames {
            let answers: Vec<_> = world.sims.iter_mut().filter_map(|sim| sim.answer(frame)).collect();
            for answer in &answers {
                world.bus.feed(answer, world.now);
            }
        }
        // Requested again, the answer stands.
        assert_eq!((world.stop().len(), still_on(&world)), (2, vec!["joint_2".to_owned()]));
    }
    assert_eq!(world.bus.state(), BusState::Stopped);
    let mut world = World::armed();
    world.disarm();
    world.run_until(BusState::Disarmed);
    assert_eq!(still_on(&world), [""; 0]);
}

#[test]
fn every_motor_takes_its_turn_to_be_first() {
    let mut world = World::ready();
    let first: Vec<u8> = (0..4)
        .map(|_| {
            world.cycle();
            world.sent[0].data[0]
        })
        .collect();
    assert!(first == [1, 2, 1, 2] || first == [2, 1, 2, 1], "{first:?}");
}

#[test]
fn an_arm_has_time_for_all_its_cycles() {
    let mut slow = spec(vec![motor(1, 0x11, MIT)]);
    (slow.hz, slow.silent_after) = (10, Duration::from_secs(1));
    let mut world = World::new(slow);
    world.sims[0].mode = 2;
    world.latency = 1;
    world.arm();
    while world.bus.state() == BusState::Arming {
        world.now = world.now.after(Duration::from_millis(95));
        world.cycle();
    }
    assert_eq!(world.bus.state(), BusState::Holding);
}

#[test]
fn no_joint_starts_from_a_single_damaged_frame() {
    for cycles in 0..40 {
        let mut world = World::ready();
        world.arm();
        world.run(cycles);
        // 1 rad off, and the newest before whatever comes next. The world knows nothing of it, and judges each command.
        let mut frame = world.sims[0].feedback().unwrap();
        let count = u16::from_be_bytes([frame.data[1], frame.data[2]]) + 2621;
        [frame.data[1], frame.data[2]] = count.to_be_bytes();
        world.bus.feed(&frame, world.now);
        world.run_until(BusState::Holding);
    }
}

#[test]
fn an_arm_is_refused_after_the_program_stalled() {
    let mut world = World::ready();
    world.now = world.now.after(Duration::from_mins(1));
    world.arm();
    world.cycle();
    assert!(matches!(world.run_to_fault(), Fault::Stalled { after } if after >= Duration::from_mins(1)));
    world.arm();
    world.run_until(BusState::Holding);
}

#[test]
fn a_short_command_of_another_program_is_detected_too() {
    let mut world = World::armed();
    let frame = CanFrame { id: 0x201, len: 4, ..CanFrame::default() };
    world.bus.feed(&CanFrame { error: true, ..frame }, world.now);
    world.cycle();
    assert_eq!(world.bus.state(), BusState::Holding);
    world.bus.feed(&frame, world.now);
    world.cycle();
    assert_eq!(world.run_to_fault(), Fault::OtherMaster { motor: 0 });
}
