//! Whatever happens, in whatever order: the judge of [`World`] sees every frame.

use proptest::prelude::*;
use rapid_registry::{Mounting, Stop};

use super::*;
use crate::control::damiao::codec::StateCommand;

#[derive(Debug, Clone)]
enum Event {
    Cycles(usize),
    Arm,
    Disarm,
    Target([f64; 2], i64),
    Silence(usize, bool),
    Status(usize, u8),
    Broken(usize, Option<u8>),
    Push(usize, f64),
    Stuck(usize, bool),
    Heat(usize, u8),
    Deaf(usize, Option<StateCommand>),
    PowerCycle(usize),
    StuckBrakes(bool),
    BrokenBrakes(u16),
    Latency(usize),
    HeldUp(u64),
    Frame(u32, [u8; 8]),
}

fn target() -> impl Strategy<Value = f64> {
    prop_oneof![8 => -2.5..2.5, 1 => any::<f64>(), 1 => Just(f64::NAN)]
}

/// Of a motor that counts beyond all limits of its joint.
fn mounting() -> impl Strategy<Value = Mounting> {
    (prop_oneof![Just(0.0_f64), -9.0_f64..9.0], any::<bool>()).prop_map(|(zero, reversed)| Mounting { zero, reversed })
}

fn event() -> impl Strategy<Value = Event> {
    use Event::*;
    let motor = 0..2_usize;
    prop_oneof![
        12 => (1..40_usize).prop_map(Cycles),
        6 => Just(Arm),
        1 => Just(Disarm),
        12 => ([target(), target()], -30_i64..5).prop_map(|(target, ms)| Target(target, ms)),
        2 => (motor.clone(), any::<bool>()).prop_map(|(motor, on)| Silence(motor, on)),
        1 => (motor.clone(), 0..16_u8).prop_map(|(motor, code)| Status(motor, code)),
        1 => (motor.clone(), proptest::option::of(8..15_u8)).prop_map(|(motor, code)| Broken(motor, code)),
        2 => (motor.clone(), -3.0..3.0).prop_map(|(motor, q)| Push(motor, q)),
        2 => (motor.clone(), any::<bool>()).prop_map(|(motor, on)| Stuck(motor, on)),
        1 => (motor.clone(), 20..110_u8).prop_map(|(motor, celsius)| Heat(motor, celsius)),
        1 => (motor.clone(), prop_oneof![
            Just(None), Just(Some(StateCommand::Enable)), Just(Some(StateCommand::Disable)), Just(Some(StateCommand::ClearError)),
        ]).prop_map(|(motor, command)| Deaf(motor, command)),
        1 => motor.prop_map(PowerCycle),
        1 => any::<bool>().prop_map(StuckBrakes),
        1 => (0..4_u16).prop_map(BrokenBrakes),
        1 => (0..4_usize).prop_map(Latency),
        1 => (1..200_u64).prop_map(HeldUp),
        1 => (0..0x20_u32, any::<[u8; 8]>()).prop_map(|(id, data)| Frame(id, data)),
    ]
}

impl Event {
    fn apply(self, world: &mut World) {
        match self {
            Self::Cycles(cycles) => world.run(cycles),
            Self::Arm => world.arm(),
            Self::Disarm => world.disarm(),
            Self::Target(target, ms) => {
                let by = Duration::from_millis(ms.unsigned_abs());
                let tick = if ms < 0 { world.now.before(by) } else { world.now.after(by) };
                world.bus.target(&target, tick, world.now);
            }
            Self::Silence(motor, on) => world.sims[motor].silent = on,
            Self::Status(motor, code) => world.sims[motor].status = MotorStatus::from_code(code),
            Self::Broken(motor, code) => world.sims[motor].broken = code.map(MotorStatus::from_code),
            Self::Push(motor, q) => world.sims[motor].q = q,
            Self::Stuck(motor, on) => world.sims[motor].stuck = on,
            Self::Heat(motor, celsius) => world.sims[motor].mos = celsius,
            Self::Deaf(motor, command) => world.sims[motor].deaf = command,
            Self::PowerCycle(motor) => world.sims[motor] = Sim { mode: 2, ..world.sims[motor].renewed() },
            Self::StuckBrakes(are_stuck) => world.are_brakes_stuck = are_stuck,
            Self::BrokenBrakes(broken) => world.brakes.broken = broken,
            Self::Latency(cycles) => world.latency = cycles,
            Self::HeldUp(ms) => world.now = world.now.after(Duration::from_millis(ms)),
            // A stranger's: one of a motor would be the motor's word.
            Self::Frame(id, data) => {
                if !world.sims.iter().any(|sim| u32::from(sim.master) == id) {
                    world.feed(&CanFrame { id, len: 8, data, ..CanFrame::default() }, world.now);
                }
            }
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(ProptestConfig::default().cases / 2))]

    #[test]
    fn motors_move_only_as_permitted(
        events in prop::collection::vec(event(), 1..60), torque in prop_oneof![Just(1000.0), 0.5..5.0],
        stop in prop::sample::select(vec![Stop::Limp, Stop::Damp, Stop::Hold, Stop::Brake]),
        has_brakes in any::<bool>(), mountings in prop::array::uniform2(mounting()),
        modes in prop::sample::select(vec![
            [MIT, MIT], [MIT, MotorMode::PositionVelocity], [MotorMode::Velocity, MIT],
        ]),
    ) {
        let mut spec = spec(vec![motor(1, 0x11, modes[0]), motor(2, 0x12, modes[1])]);
        spec.motors.iter_mut().for_each(|motor| motor.torque = torque);
        spec.motors[0].stop.other_fault = stop;
        spec.motors[1].stop.own_fault = stop;
        spec.motors.iter_mut().zip(mountings).for_each(|(motor, mounting)| motor.mounting = mounting);
        spec.motors.iter_mut().for_each(|motor| motor.brake = has_brakes.then(world::brake));
        let mut world = World::new(spec);
        for event in events {
            event.apply(&mut world);
        }
        // What was broken is repaired: from anywhere within the limits, an arm works.
        for sim in &mut world.sims {
            *sim = Sim { mode: sim.mode, q: sim.q.clamp(-2.0, 2.0), status: sim.status, ..sim.renewed() };
            if matches!(sim.status, MotorStatus::Other(_)) {
                sim.status = MotorStatus::Disabled;
            }
        }
        world.latency = 0;
        (world.are_brakes_stuck, world.brakes.broken) = (false, 0);
        world.run(300);
        world.disarm();
        world.run(300);
        prop_assert!(!world.sims.iter().any(Sim::is_on), "{:?}", world.bus.state());
        // It may have been commanded to stay where it was pushed.
        world.sims.iter_mut().for_each(|sim| sim.q = sim.q.clamp(-2.0, 2.0));
        world.run(2);
        world.arm();
        world.run(60);
        if matches!(world.bus.state(), BusState::Faulted(Fault::Latched { .. })) {
            // It had not been reported: now it was.
            world.arm();
            world.run(60);
        }
        prop_assert!(world.bus.is_armed(), "{:?} {:?}", world.bus.state(), world.sims);
        let commands: Vec<CanFrame> = world.stop();
        prop_assert_eq!(commands.len(), 2);
        world.run(5);
    }
}
