//! What differs between the registry of a run and the text that its file holds now, and what of it a run can take over.
//!
//! Pure. A run takes over added entries, each at a free bit, and nothing else: shared memory, the channels of an episode
//! and the bits of a policy are fixed for everything that exists.
//!
//! Invariant: a difference is either an added entry that a run can take over, or it has a line in
//! [`Difference::needs_restart`].

use super::spec::{
    ActionSpec, ButtonSpec, DeviceSpec, Hooks, IdentitySpec, InterlockSpec, ModuleSpec, NodeSpec, Registry, RigSpec,
};

/// See the module's comment.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Difference {
    /// Entries that a run can take over, ascending by bit.
    pub added: Vec<DeviceSpec>,
    /// Names of modules that a run can take over.
    pub modules: Vec<String>,
    /// What it cannot take over: one line each, what and why.
    pub needs_restart: Vec<String>,
}

impl Difference {
    /// From the registry of a run to a new one.
    pub fn between(running: &Registry, new: &Registry) -> Self {
        let mut found = Self::default();
        let Registry { rig, inference, export, devices, modules, stops, buttons, path: _, text: _ } = running;
        found.rig(rig, &new.rig);
        if *inference != new.inference {
            found.needs_restart.push("[inference]: it changed, and is read at the start".to_owned());
        }
        if *export != new.export {
            found.needs_restart.push("[export]: it changed, and episodes have the registry of the start".to_owned());
        }
        for device in devices {
            match new.named(&device.name) {
                Some(now) => found.device(device, now),
                None => found.restart(
                    &device.name,
                    format!("it is removed, and its topic lasts as long as the run{}", renamed(device, running, new)),
                ),
            }
        }
        for device in new.devices.iter().filter(|device| running.named(&device.name).is_none()) {
            match obstacle(device, running, new) {
                Some(why) => found.restart(&device.name, why),
                None => found.added.push(device.clone()),
            }
        }
        let is_added = |module: &&ModuleSpec| modules.iter().all(|other| other.name != module.name);
        let (added, kept): (Vec<_>, Vec<_>) = new.modules.iter().cloned().partition(|module| is_added(&module));
        found.modules = added.into_iter().map(|module| module.name).collect();
        found.list(modules, &kept, "[module]", |module: &ModuleSpec| &module.name);
        found.list(stops, &new.stops, "[stop]", |stop: &InterlockSpec| &stop.name);
        found.list(buttons, &new.buttons, "[button]", |button: &ButtonSpec| &button.name);
        found
    }

    fn restart(&mut self, name: &str, why: impl std::fmt::Display) {
        self.needs_restart.push(format!("[device.{name}]: {why}"));
    }

    fn rig(&mut self, was: &RigSpec, is: &RigSpec) {
        let RigSpec { name, observation_hz, sync_window, cooldown, memory_budget, disk_reserve, expect } = was;
        let changed = [
            ("name", differs(name, &is.name)),
            ("observation_hz", differs(observation_hz, &is.observation_hz)),
            ("sync_window", differs(sync_window, &is.sync_window)),
            ("cooldown", differs(cooldown, &is.cooldown)),
            ("memory_budget", differs(memory_budget, &is.memory_budget)),
            ("disk_reserve", differs(disk_reserve, &is.disk_reserve)),
            ("expect", differs(expect, &is.expect)),
        ];
        let changed = names(changed);
        if !changed.is_empty() {
            self.needs_restart.push(format!("[rig]: {changed} changed, which is read at the start"));
        }
    }

    fn device(&mut self, was: &DeviceSpec, is: &DeviceSpec) {
        let DeviceSpec {
            name,
            id,
            identity,
            node,
            topic,
            mount,
            stall_after,
            max_bytes,
            depth,
            when_stale,
            latency,
            verdict,
            form,
            action,
            hooks,
        } = was;
        if *id != is.id {
            self.restart(
                name,
                format!("its bit {id} is now {}, and recordings and policies know it by its bit", is.id),
            );
        }
        if depth != &is.depth {
            let why =
                "its memory is reserved; a depth that is not written follows from memory_budget and the other entries";
            self.restart(name, format!("its depth {depth} is now {}: {why}", is.depth));
        }
        let changed = names([
            ("identity", differs(identity, &is.identity)),
            ("node", std::mem::discriminant(node) != std::mem::discriminant(&is.node)),
            ("format", differs(node, &is.node) && std::mem::discriminant(node) == std::mem::discriminant(&is.node)),
            ("topic", differs(topic, &is.topic)),
            ("slot", differs(mount, &is.mount)),
            ("stall_after", differs(stall_after, &is.stall_after)),
            ("max_bytes", differs(max_bytes, &is.max_bytes)),
            ("when_stale", differs(when_stale, &is.when_stale)),
            ("latency", differs(latency, &is.latency)),
            ("verdict", differs(verdict, &is.verdict)),
            ("form", differs(form, &is.form)),
            ("action", differs::<Option<ActionSpec>>(action, &is.action)),
            ("hooks", differs::<Hooks>(hooks, &is.hooks)),
        ]);
        if !changed.is_empty() {
            self.restart(name, format!("{changed} changed, and a run does not change an entry that it has"));
        }
    }

    fn list<'a, T: PartialEq>(&mut self, was: &'a [T], is: &'a [T], table: &str, name: impl Fn(&T) -> &String) {
        if was == is {
            return;
        }
        let named = |list: &'a [T], wanted: &T| list.iter().find(|other| name(other) == name(wanted));
        let removed = was.iter().filter(|item| named(is, item).is_none()).map(|item| (item, "removed"));
        let changed = is.iter().filter_map(|item| match named(was, item) {
            None => Some((item, "added")),
            Some(before) => (before != item).then_some((item, "changed")),
        });
        let which: Vec<String> = removed.chain(changed).map(|(item, how)| format!("{} {how}", name(item))).collect();
        let which = if which.is_empty() { "the order changed".to_owned() } else { which.join(", ") };
        self.needs_restart.push(format!("{table}: {which}; it is read at the start"));
    }
}

fn differs<T: PartialEq>(was: &T, is: &T) -> bool {
    was != is
}

fn names<const N: usize>(changed: [(&str, bool); N]) -> String {
    let changed: Vec<&str> = changed.into_iter().filter_map(|(name, is_changed)| is_changed.then_some(name)).collect();
    changed.join(", ")
}

/// A remark about the new name of an entry, if it has only been renamed.
fn renamed(was: &DeviceSpec, running: &Registry, new: &Registry) -> String {
    let is_new = |device: &&DeviceSpec| running.named(&device.name).is_none();
    let same = new.devices.iter().filter(is_new).find(|now| (&now.identity, now.id) == (&was.identity, was.id));
    same.map_or_else(String::new, |now| format!(" (renamed to {}?)", now.name))
}

/// Why a run cannot take this entry over, if it cannot.
fn obstacle(device: &DeviceSpec, running: &Registry, new: &Registry) -> Option<String> {
    if let Some(holder) = running.device(device.id) {
        return Some(format!("its bit {} is that of [device.{}] in this run", device.id, holder.name));
    }
    if let Some(holder) = running.devices.iter().find(|other| other.topic == device.topic) {
        return Some(format!("its topic {} is that of [device.{}] in this run", device.topic, holder.name));
    }
    if device.action.is_some() {
        return Some("an actuator is set up at the start, before anything may move".to_owned());
    }
    if new.shares_unit(device) {
        return Some(
            "the streams of a camera are distinguished by what discovery asks of it from the start".to_owned(),
        );
    }
    if !device.hooks.is_empty() {
        return Some("its hooks need what a run sets up for programs at its start".to_owned());
    }
    if let Some(why) = device.node.of_kind().only_at_start() {
        return Some(why.to_owned());
    }
    if let Some(other) = running.devices.iter().find(|other| compete(device, other)) {
        let why = format!("a device of its service may belong to [device.{}], which this run searches for", other.name);
        // Without one in the running entry: it would have to get it, and a run does not change an entry that it has.
        let is_named = announced(other).is_some_and(|(_, instance)| instance.is_some());
        let another = format!("write another `instance` in [device.{}.lan], or ", device.name);
        return Some(format!("{why}; {}restart rapid", if is_named { another.as_str() } else { "" }));
    }
    let weaker = running.devices.iter().find(|other| takes_from(device, other))?;
    Some(format!("it would take a unit that may be attached as [device.{}]", weaker.name))
}

/// Whether both are found by the same announced service, and not by two instances of it: a search assigns the instances of a
/// service to all its entries when it starts.
fn compete(device: &DeviceSpec, other: &DeviceSpec) -> bool {
    let (Some((own, mine)), Some((theirs, another))) = (announced(device), announced(other)) else { return false };
    let differ = mine.zip(another).is_some_and(|(mine, another)| !mine.eq_ignore_ascii_case(another));
    own.eq_ignore_ascii_case(theirs) && !differ
}

fn announced(device: &DeviceSpec) -> Option<(&str, Option<&str>)> {
    match &device.node {
        NodeSpec::Lan(lan) => lan.find.announced(),
        _ => None,
    }
}

/// Whether a unit that `other` accepts may belong to `device` alone, by the rules of `identity`.
fn takes_from(device: &DeviceSpec, other: &DeviceSpec) -> bool {
    let (IdentitySpec::Usb(own), IdentitySpec::Usb(theirs)) = (&device.identity, &other.identity) else { return false };
    let same = (own.vid, own.pid, device.node.opens()) == (theirs.vid, theirs.pid, other.node.opens());
    // By serial number, by port, by neither.
    let rank = |serial: &Option<String>, port: &Option<String>| match (serial, port) {
        (Some(_), _) => 0,
        (None, Some(_)) => 1,
        (None, None) => 2,
    };
    same && rank(&own.serial, &own.port) < rank(&theirs.serial, &theirs.port)
}

#[cfg(test)]
mod tests;
