//! Tests of the synchroniser: tables for the rules, properties for what holds always.

use proptest::prelude::*;

use super::*;
use crate::mask::PhysicalMask;

const MS: u64 = 1_000_000;

fn id(bit: u8) -> ModalityId {
    ModalityId::new(bit).unwrap()
}

fn modality(bit: u8, when_stale: WhenStale) -> SyncModality {
    SyncModality { id: id(bit), when_stale, latency: Duration::ZERO, capacity: 64 }
}

fn sample(capture_ms: u64, recv_ms: u64, seq: u64, epoch: u32) -> SyncSample<()> {
    SyncSample { capture: Stamp(capture_ms * MS), recv: Stamp(recv_ms * MS), seq, epoch: Epoch(epoch), keep: () }
}

/// A slot in short: present, valid, stale, age in ms, seq.
type ShortSlot = (bool, bool, bool, i64, Option<u64>);

fn check(when_stale: WhenStale, samples: &[SyncSample<()>], tick_ms: u64, now_ms: u64, mask: u64, expected: ShortSlot) {
    let mut sync = Synchronizer::new(&[modality(0, when_stale)], Duration::from_millis(25));
    for sample in samples {
        sync.push(id(0), *sample);
    }
    let slot = sync.observe(Stamp(tick_ms * MS), Stamp(now_ms * MS), PhysicalMask(mask)).slots[0];
    let age_ms = slot.age_ns / i64::try_from(MS).unwrap();
    assert_eq!((slot.present, slot.valid, slot.stale, age_ms, slot.seq), expected, "{samples:?} at {tick_ms}");
    assert_eq!(slot.handle.is_some(), slot.seq.is_some());
}

#[test]
fn an_added_modality_is_in_the_order_of_bits_and_changes_no_other() {
    let mut sync =
        Synchronizer::new(&[modality(1, WhenStale::Hold), modality(5, WhenStale::Hold)], Duration::from_millis(25));
    sync.push(id(1), sample(100, 101, 7, 1));
    sync.push(id(5), sample(100, 101, 8, 1));
    sync.push(id(3), sample(100, 101, 9, 1));
    for bit in [3, 9, 0, 3] {
        sync.add(&modality(bit, WhenStale::Hold));
    }
    sync.push(id(9), sample(101, 101, 4, 1));
    let seen = sync.observe(Stamp(100 * MS), Stamp(110 * MS), PhysicalMask(u64::MAX));
    let slots: Vec<_> = seen.slots.iter().map(|slot| (slot.id.bit(), slot.seq)).collect();
    assert_eq!(slots, [(0, None), (1, Some(7)), (3, None), (5, Some(8)), (9, Some(4))]);
}

#[test]
fn each_rule_decides_as_written() {
    use WhenStale::{Hold, Zero};
    let near = [sample(90, 95, 1, 1), sample(105, 110, 2, 1), sample(140, 150, 3, 1)];
    // The nearest wins, before or after the tick.
    check(Hold, &near, 100, 200, 1, (true, true, false, -5, Some(2)));
    check(Hold, &near, 96, 200, 1, (true, true, false, 6, Some(1)));
    // Both ends of the window count.
    check(Hold, &[sample(75, 80, 7, 1)], 100, 200, 1, (true, true, false, 25, Some(7)));
    check(Hold, &[sample(125, 130, 7, 1)], 100, 200, 1, (true, true, false, -25, Some(7)));
    check(Hold, &[sample(74, 80, 7, 1)], 100, 200, 1, (true, false, true, 26, Some(7)));
    // Not received yet, or not captured yet, counts for nothing.
    check(Hold, &near, 100, 109, 1, (true, true, false, 10, Some(1)));
    check(Hold, &[sample(110, 90, 1, 1)], 100, 105, 1, (true, false, true, 0, None));
    // Equally near: the earlier; captured together: the lower sequence number.
    check(Hold, &[sample(110, 111, 2, 1), sample(90, 91, 1, 1)], 100, 200, 1, (true, true, false, 10, Some(1)));
    check(Hold, &[sample(90, 91, 5, 1), sample(90, 91, 4, 1)], 100, 200, 1, (true, true, false, 10, Some(4)));
    // A clear bit wins over anything in the ring.
    check(Hold, &near, 100, 200, 2, (false, false, false, 0, None));
    // Nothing in the window: hold the newest at or before the tick, never a later one; or nothing.
    check(Hold, &near, 180, 300, 1, (true, false, true, 40, Some(3)));
    check(Zero, &near, 180, 300, 1, (true, false, true, 0, None));
    check(Hold, &[sample(180, 181, 1, 1)], 100, 300, 1, (true, false, true, 0, None));
    check(Hold, &[], 100, 300, 1, (true, false, true, 0, None));
    // After a replug the old attachment's samples are gone, but only once the new one has sent, and
    // not for ticks that lie before it: who looks back sees what was to be seen.
    let replug = [sample(95, 96, 8, 1), sample(150, 160, 9, 2)];
    check(Hold, &replug, 100, 155, 1, (true, true, false, 5, Some(8)));
    check(Hold, &replug, 100, 200, 1, (true, true, false, 5, Some(8)));
    check(Hold, &replug, 124, 200, 1, (true, false, true, 29, Some(8)));
    check(Hold, &replug, 125, 200, 1, (true, true, false, -25, Some(9)));
    check(Hold, &replug, 170, 200, 1, (true, true, false, 20, Some(9)));
    let quick = [sample(95, 96, 8, 1), sample(101, 102, 9, 2)];
    check(Hold, &quick, 97, 200, 1, (true, true, false, -4, Some(9)));
}

#[test]
fn a_full_ring_keeps_the_newest_pushed_and_handles_lead_to_the_sample() {
    let modalities = [SyncModality { id: id(3), when_stale: WhenStale::Hold, latency: Duration::ZERO, capacity: 4 }];
    let mut sync = Synchronizer::new(&modalities, Duration::from_millis(1));
    for n in 0..10_u64 {
        let stamp = Stamp(n * MS);
        sync.push(id(3), SyncSample { capture: stamp, recv: stamp, seq: n, epoch: Epoch(1), keep: n * 11 });
    }
    sync.push(id(9), SyncSample { capture: Stamp(0), recv: Stamp(0), seq: 0, epoch: Epoch(1), keep: 0 });
    let slot = *sync.observe(Stamp(8 * MS), Stamp(20 * MS), PhysicalMask(8)).slot(id(3)).unwrap();
    assert_eq!(sync.sample(&slot).map(|s| s.keep), Some(88));
    let slot = *sync.observe(Stamp(4 * MS), Stamp(20 * MS), PhysicalMask(8)).slot(id(3)).unwrap();
    assert_eq!((slot.valid, slot.stale, slot.seq), (false, true, None), "4 ms was pushed out by 9 ms");
    sync.clear();
    assert!(!sync.observe(Stamp(8 * MS), Stamp(20 * MS), PhysicalMask(8)).slots[0].valid);
}

#[test]
fn the_grid_does_not_drift() {
    let grid = Grid::new(Stamp(1_000), 30.0);
    assert_eq!(grid.tick(0), Stamp(1_000));
    assert_eq!(grid.tick(1), Stamp(1_000 + 33_333_333));
    assert_eq!(grid.tick(3), Stamp(1_000 + 100_000_000));
    // A day later exactly on the second.
    assert_eq!(grid.tick(30 * 86_400), Stamp(1_000 + 86_400_000_000_000));
    assert_eq!(grid.ticks_before(Stamp(1_000)), 0);
    assert_eq!(grid.ticks_before(Stamp(1_001)), 1);
    assert_eq!(grid.ticks_before(Stamp(1_000 + 100_000_000)), 3);
    assert_eq!(Grid::new(Stamp(0), f64::NAN).tick(1), Stamp(1_000_000_000_000_000));
    assert_eq!(Grid::new(Stamp(5), 0.1).tick(u64::MAX), Stamp(u64::MAX));
}

fn samples() -> impl Strategy<Value = Vec<(u8, SyncSample<()>)>> {
    let one = (0_u8..3, 0_u64..300, 0_u64..60, 0_u64..50, 1_u32..4);
    let one = one.prop_map(|(bit, capture, late, seq, epoch)| (bit, sample(capture, capture + late, seq, epoch)));
    proptest::collection::vec(one, 0..60)
}

fn synchronizer(samples: &[(u8, SyncSample<()>)]) -> Synchronizer<()> {
    let modalities = [modality(0, WhenStale::Hold), modality(1, WhenStale::Zero), modality(2, WhenStale::Hold)];
    let mut sync = Synchronizer::new(&modalities, Duration::from_millis(25));
    for (bit, sample) in samples {
        sync.push(id(*bit), *sample);
    }
    sync
}

/// An observation without the handles, which name places in a ring.
fn report(observation: &Observation) -> Vec<ShortSlot> {
    observation.slots.iter().map(|s| (s.present, s.valid, s.stale, s.age_ns, s.seq)).collect()
}

proptest! {
    #[test]
    fn slot_states_follow_from_the_samples(samples in samples(), tick in 0_u64..350, late in 0_u64..150, mask in 0_u64..8) {
        let (tick, now) = (Stamp(tick * MS), Stamp((tick + late) * MS));
        let mut sync = synchronizer(&samples);
        let observation = sync.observe(tick, now, PhysicalMask(mask)).clone();
        prop_assert_eq!(observation.slots.len(), 3);
        for slot in &observation.slots {
            let known = || samples.iter().filter(|(bit, s)| *bit == slot.id.bit() && s.recv <= now && s.capture <= now).map(|(_, s)| s);
            let epoch = known().filter(|s| s.capture.0 <= tick.0 + 25 * MS).map(|s| s.epoch).max();
            let in_window = |s: &SyncSample<()>| s.capture.0.abs_diff(tick.0) <= 25 * MS;
            let candidates = known().filter(|s| Some(s.epoch) == epoch && in_window(s)).count();
            // Absent iff the bit is clear; present is valid or stale, never both.
            prop_assert_eq!(slot.present, mask >> slot.id.bit() & 1 == 1);
            prop_assert_eq!(slot.present, slot.valid || slot.stale);
            prop_assert!(!(slot.valid && slot.stale));
            prop_assert_eq!(slot.valid, slot.present && candidates > 0);
            match sync.sample(slot) {
                Some(chosen) => {
                    prop_assert!(chosen.recv <= now && chosen.capture <= now);
                    prop_assert_eq!(Some(chosen.epoch), epoch);
                    prop_assert_eq!(Some(chosen.seq), slot.seq);
                    prop_assert_eq!(i128::from(slot.age_ns), i128::from(tick.0) - i128::from(chosen.capture.0));
                    prop_assert_eq!(slot.valid, in_window(chosen));
                    let better = |s: &&SyncSample<()>| Some(s.epoch) == epoch && s.capture.0.abs_diff(tick.0) < chosen.capture.0.abs_diff(tick.0);
                    if slot.valid { prop_assert_eq!(known().filter(better).count(), 0); }
                    else { prop_assert!(slot.age_ns > 0); }
                }
                None => prop_assert!(!slot.valid && slot.seq.is_none() && slot.age_ns == 0),
            }
        }
        // Idempotent.
        prop_assert_eq!(sync.observe(tick, now, PhysicalMask(mask)), &observation);
    }

    #[test]
    fn the_order_of_pushes_does_not_matter(
        (samples, shuffled) in samples().prop_flat_map(|s| (Just(s.clone()), Just(s).prop_shuffle())),
        tick in 0_u64..350, late in 0_u64..150, mask in 0_u64..8,
    ) {
        let (tick, now) = (Stamp(tick * MS), Stamp((tick + late) * MS));
        let mut one = synchronizer(&samples);
        let mut other = synchronizer(&shuffled);
        prop_assert_eq!(report(one.observe(tick, now, PhysicalMask(mask))), report(other.observe(tick, now, PhysicalMask(mask))));
    }

    #[test]
    fn a_sample_received_after_now_changes_nothing(samples in samples(), extra in samples(), tick in 0_u64..350, late in 0_u64..150) {
        let (tick, now) = (Stamp(tick * MS), Stamp((tick + late) * MS));
        let before = report(synchronizer(&samples).observe(tick, now, PhysicalMask(7)));
        let mut sync = synchronizer(&samples[..samples.len().min(4)]);
        let few = report(sync.observe(tick, now, PhysicalMask(7)));
        for (bit, sample) in extra {
            sync.push(id(bit), SyncSample { recv: Stamp(now.0 + 1 + sample.recv.0), ..sample });
        }
        prop_assert_eq!(report(sync.observe(tick, now, PhysicalMask(7))), few);
        prop_assert_eq!(before.len(), 3);
    }

    #[test]
    fn a_latency_undoes_the_delay_of_its_modality(
        samples in samples(), latencies in proptest::array::uniform3(0_u64..1_000_000_000),
        tick in 0_u64..350, late in 0_u64..150, mask in 0_u64..8,
    ) {
        let (tick, now) = (Stamp(tick * MS), Stamp((tick + late) * MS));
        let prompt = report(synchronizer(&samples).observe(tick, now, PhysicalMask(mask)));
        let modalities = [(0, WhenStale::Hold), (1, WhenStale::Zero), (2, WhenStale::Hold)].map(|(bit, when_stale)| {
            let latency = Duration::from_nanos(latencies[usize::from(bit)]);
            SyncModality { latency, ..modality(bit, when_stale) }
        });
        let mut sync = Synchronizer::new(&modalities, Duration::from_millis(25));
        for (bit, sample) in &samples {
            let capture = Stamp(sample.capture.0 + latencies[usize::from(*bit)]);
            sync.push(id(*bit), SyncSample { capture, ..*sample });
        }
        prop_assert_eq!(report(sync.observe(tick, now, PhysicalMask(mask))), prompt);
    }

    #[test]
    fn ticks_before_agrees_with_tick(begin in 0_u64..1 << 40, hz in 0.1_f64..1000.0, span in 0_u64..1 << 36) {
        let grid = Grid::new(Stamp(begin), hz);
        let count = grid.ticks_before(Stamp(begin + span));
        prop_assert!(grid.tick(count).0 >= begin + span);
        prop_assert!(count == 0 || grid.tick(count - 1).0 < begin + span);
    }
}
