//! `librapid_node.a`: what `rapid_node.h` declares.
//!
//! It is not a binding of iceoryx2. A program that has one can do without this library: topic, types and header
//! are those of docs/interfaces.md.

use std::cell::RefCell;
use std::error::Error;
use std::ffi::{CStr, CString, c_char, c_int};
use std::time::Duration;

use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::*;
use iceoryx2::sample::Sample;

/// Stands beside every payload; `rapid_core::sample::SampleHeader`.
#[derive(Debug, Clone, Copy, Default, ZeroCopySend)]
#[type_name("RapidSampleHeader")]
#[repr(C)]
struct SampleHeader {
    seq: u64,
    lost: u64,
    capture_ns: u64,
    recv_ns: u64,
    id: u32,
    epoch: u32,
    encoding: u32,
    flags: u32,
    width: u32,
    height: u32,
}

/// `struct rapid_sample`.
#[repr(C)]
pub struct RapidSample {
    bytes: *const u8,
    length: usize,
    capture_ns: u64,
    lost: u64,
    encoding: u32,
    width: u32,
    height: u32,
}

/// `rapid_node`.
pub struct RapidNode {
    publisher: Publisher<ipc::Service, [u8], SampleHeader>,
    wake: Notifier<ipc::Service>,
    /// What all headers have in common, and the sequence number of the next.
    header: SampleHeader,
    _node: Node<ipc::Service>,
}

/// `struct rapid_received`.
#[repr(C)]
pub struct RapidReceived {
    bytes: *const u8,
    length: usize,
    seq: u64,
    lost: u64,
    capture_ns: u64,
    epoch: u32,
    encoding: u32,
    width: u32,
    height: u32,
}

/// `rapid_subscriber`.
pub struct RapidSubscriber {
    subscriber: Subscriber<ipc::Service, [u8], SampleHeader>,
    /// The sample whose bytes the program may still read.
    newest: Option<Sample<ipc::Service, [u8], SampleHeader>>,
    node: Node<ipc::Service>,
}

thread_local! {
    static ERROR: RefCell<CString> = RefCell::default();
}

/// See `rapid_node.h`.
#[unsafe(no_mangle)]
pub extern "C" fn rapid_node_open(max_bytes: usize) -> *mut RapidNode {
    match open(max_bytes) {
        Ok(node) => Box::into_raw(Box::new(node)),
        Err(error) => {
            report(&*error);
            std::ptr::null_mut()
        }
    }
}

/// See `rapid_node.h`.
///
/// # Safety
/// `node` comes from [`rapid_node_open`] and was not closed; `sample` and its bytes can be read.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rapid_node_publish(node: *mut RapidNode, sample: *const RapidSample) -> c_int {
    // SAFETY: the caller keeps to the header: both are null or valid, and no other thread uses the node meanwhile.
    let (Some(node), Some(sample)) = (unsafe { node.as_mut() }, unsafe { sample.as_ref() }) else {
        report(&*Box::<dyn Error>::from("no node or no sample"));
        return -1;
    };
    let bytes = if sample.length == 0 || sample.bytes.is_null() {
        &[]
    } else {
        // SAFETY: the caller guarantees this number of bytes; they are only read, before this returns.
        unsafe { std::slice::from_raw_parts(sample.bytes, sample.length) }
    };
    match publish(node, sample, bytes) {
        Ok(()) => 0,
        Err(error) => {
            report(&*error);
            -1
        }
    }
}

/// See `rapid_node.h`.
///
/// # Safety
/// `node` comes from [`rapid_node_open`] and is not used any more.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rapid_node_close(node: *mut RapidNode) {
    if !node.is_null() {
        // SAFETY: it was made by `Box::into_raw`, and the caller gives it back.
        drop(unsafe { Box::from_raw(node) });
    }
}

/// See `rapid_node.h`.
#[unsafe(no_mangle)]
pub extern "C" fn rapid_node_error() -> *const c_char {
    ERROR.with_borrow(|error| error.as_ptr())
}

/// See `rapid_node.h`.
///
/// # Safety
/// `topic` is null or a text that ends with a zero byte.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rapid_subscriber_open(topic: *const c_char) -> *mut RapidSubscriber {
    let subscribed = if topic.is_null() {
        Err("no topic".into())
    } else {
        // SAFETY: the caller passes a text that ends with a zero byte.
        subscribe(&unsafe { CStr::from_ptr(topic) }.to_string_lossy())
    };
    match subscribed {
        Ok(subscriber) => Box::into_raw(Box::new(subscriber)),
        Err(error) => {
            report(&*error);
            std::ptr::null_mut()
        }
    }
}

/// See `rapid_node.h`.
///
/// # Safety
/// `subscriber` comes from [`rapid_subscriber_open`] and was not closed; `received` can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rapid_subscriber_receive(
    subscriber: *mut RapidSubscriber,
    received: *mut RapidReceived,
) -> c_int {
    // SAFETY: the caller keeps to the header: both are null or valid, and nothing else uses the subscriber meanwhile.
    let (Some(subscriber), false) = (unsafe { subscriber.as_mut() }, received.is_null()) else {
        report(&*Box::<dyn Error>::from("no subscriber or no place for a sample"));
        return -1;
    };
    match receive(subscriber) {
        Ok(sample) => {
            // SAFETY: it is not null, and the caller provides room for one.
            unsafe { received.write(sample) };
            0
        }
        Err(error) => {
            report(&*error);
            -1
        }
    }
}

/// See `rapid_node.h`.
///
/// # Safety
/// `subscriber` comes from [`rapid_subscriber_open`] and is not used any more.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rapid_subscriber_close(subscriber: *mut RapidSubscriber) {
    if !subscriber.is_null() {
        // SAFETY: it was made by `Box::into_raw`, and the caller gives it back.
        drop(unsafe { Box::from_raw(subscriber) });
    }
}

/// How long a subscriber sleeps between two looks.
const LOOK: Duration = Duration::from_millis(1);

fn subscribe(topic: &str) -> Result<RapidSubscriber, Box<dyn Error>> {
    set_log_level(LogLevel::Error);
    let mut config = Config::global_config().clone();
    let instance = || Some(format!("iox2_{}_", std::env::var("RAPID_INSTANCE").ok().filter(|name| !name.is_empty())?));
    if let Some(prefix) = std::env::var("RAPID_BUS_PREFIX").ok().or_else(instance) {
        config.global.prefix = FileName::new(prefix.as_bytes())?;
    }
    if let Ok(root) = std::env::var("RAPID_BUS_ROOT") {
        config.global.set_root_path(&Path::new(root.as_bytes())?);
    }
    let node = NodeBuilder::new()
        .config(&config)
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .create::<ipc::Service>()?;
    let name = ServiceName::new(topic)?;
    let samples = node.service_builder(&name).publish_subscribe::<[u8]>().user_header::<SampleHeader>().open()?;
    let subscriber = samples.subscriber_builder().create()?;
    Ok(RapidSubscriber { subscriber, newest: None, node })
}

fn receive(subscriber: &mut RapidSubscriber) -> Result<RapidReceived, Box<dyn Error>> {
    subscriber.newest = None;
    let sample = loop {
        match subscriber.subscriber.receive()? {
            Some(sample) => break subscriber.newest.insert(sample),
            None => subscriber.node.wait(LOOK)?,
        }
    };
    let SampleHeader { seq, lost, capture_ns, epoch, encoding, width, height, .. } = *sample.user_header();
    let bytes = sample.payload();
    Ok(RapidReceived {
        bytes: bytes.as_ptr(),
        length: bytes.len(),
        seq,
        lost,
        capture_ns,
        epoch,
        encoding,
        width,
        height,
    })
}

fn report(error: &dyn Error) {
    ERROR.set(CString::new(error.to_string().replace('\0', "")).unwrap_or_default());
}

fn open(max_bytes: usize) -> Result<RapidNode, Box<dyn Error>> {
    set_log_level(LogLevel::Error);
    let topic = variable("RAPID_TOPIC")?;
    let mut config = Config::global_config().clone();
    config.global.prefix = FileName::new(variable("RAPID_BUS_PREFIX")?.as_bytes())?;
    if let Ok(root) = std::env::var("RAPID_BUS_ROOT") {
        config.global.set_root_path(&Path::new(root.as_bytes())?);
    }
    let node = NodeBuilder::new()
        .config(&config)
        // SIGTERM ends this program as it ends any other.
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .create::<ipc::Service>()?;
    let name = ServiceName::new(&topic)?;
    let samples = node.service_builder(&name).publish_subscribe::<[u8]>().user_header::<SampleHeader>().open()?;
    let publisher = samples.publisher_builder().initial_max_slice_len(max_bytes).create()?;
    let wake = node.service_builder(&name).event().open()?.notifier_builder().create()?;
    let header = SampleHeader {
        id: variable("RAPID_BIT")?.parse()?,
        epoch: variable("RAPID_EPOCH")?.parse()?,
        ..SampleHeader::default()
    };
    Ok(RapidNode { publisher, wake, header, _node: node })
}

fn variable(name: &str) -> Result<String, Box<dyn Error>> {
    std::env::var(name).map_err(|_| format!("{name} is not set: rapid starts this program, see docs/nodes.md").into())
}

fn publish(node: &mut RapidNode, description: &RapidSample, bytes: &[u8]) -> Result<(), Box<dyn Error>> {
    let mut sample = node.publisher.loan_slice_uninit(bytes.len())?;
    let RapidSample { capture_ns, encoding, width, height, lost, .. } = *description;
    // What the device lost leaves a hole.
    let seq = node.header.seq + lost;
    *sample.user_header_mut() = SampleHeader { seq, capture_ns, encoding, width, height, ..node.header };
    sample.write_from_slice(bytes).send()?;
    // Nothing is counted until it was sent: a retry passes the same values again.
    node.header.seq = seq + 1;
    // Without a notification a sample is found a little later.
    node.wake.notify()?;
    Ok(())
}
