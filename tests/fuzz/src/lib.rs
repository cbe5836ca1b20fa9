//! Every reader of bytes that strangers wrote, as a function over bytes.
//!
//! A target is fed in two ways: by libFuzzer, guided by coverage (`make fuzz`), and by `tests/short.rs`,
//! which runs it over its seeds, over the inputs that once broke it (`cases/NAME/`) and over some
//! thousand mutations of them. A target panics when a promise is broken; what the promise is stands
//! with it.
//!
//! Invariant: a target depends on its input alone, so that an input that broke it breaks it again.

mod artifacts;
pub mod can;
pub mod lan;
pub mod motors;
pub mod mutate;
pub mod policy;
pub mod rules;
pub mod seeds;
pub mod targets;

/// A reader and how it is fed.
pub struct Target {
    /// Name, of its folder of cases too.
    pub name: &'static str,
    /// Reads the bytes; panics when a promise is broken.
    pub run: fn(&[u8]),
    /// Inputs that reach far into it.
    pub seeds: fn() -> Vec<Vec<u8>>,
}

/// All of them.
pub const TARGETS: &[Target] = &[
    Target { name: "registry", run: targets::registry, seeds: seeds::registries },
    Target { name: "scenario", run: targets::scenario, seeds: seeds::scenarios },
    Target { name: "units", run: targets::units, seeds: seeds::units },
    Target { name: "serial", run: targets::serial, seeds: seeds::serial },
    Target { name: "slcan", run: can::slcan, seeds: seeds::slcan },
    Target { name: "damiao_serial", run: can::damiao_serial, seeds: seeds::damiao_serial },
    Target { name: "multipart", run: lan::multipart, seeds: lan::multiparts },
    Target { name: "points", run: lan::points, seeds: lan::packets },
    Target { name: "phone", run: lan::phone, seeds: lan::phones },
    Target { name: "remote", run: lan::remote, seeds: lan::remotes },
    Target { name: "http_answer", run: lan::answer, seeds: lan::answers },
    Target { name: "mdns_name", run: lan::label, seeds: lan::labels },
    Target { name: "message", run: targets::message, seeds: seeds::messages },
    Target { name: "inspect", run: targets::inspect, seeds: seeds::episodes },
    Target { name: "recover", run: targets::recover, seeds: seeds::episodes },
    Target { name: "replay", run: targets::replay, seeds: seeds::episodes },
    Target { name: "mask", run: targets::mask, seeds: seeds::masks },
    Target { name: "layout", run: targets::layout, seeds: seeds::layouts },
    Target { name: "strings", run: targets::strings, seeds: seeds::strings },
    Target { name: "text", run: targets::text, seeds: seeds::strings },
    Target { name: "bundle", run: policy::bundle, seeds: policy::bundles },
    Target { name: "picture", run: policy::picture, seeds: policy::pictures },
    Target { name: "motors", run: motors::motors, seeds: motors::sessions },
];

/// The target of this name.
#[must_use]
pub fn target(name: &str) -> Option<&'static Target> {
    TARGETS.iter().find(|target| target.name == name)
}
