//! The library as a program calls it that `rapid` has not started. A test of its own also has cargo make
//! the archive with all others, for the program in C that `tests/program/nodes.rs` builds.

use std::ffi::CStr;

use rapid_node::{rapid_node_close, rapid_node_error, rapid_node_open, rapid_node_publish};

#[test]
fn without_rapid_node_creation_fails_with_a_reason() {
    let node = rapid_node_open(16);
    assert!(node.is_null());
    // SAFETY: the text is that of this thread, and nothing is called meanwhile.
    let error = || unsafe { CStr::from_ptr(rapid_node_error()) }.to_string_lossy().into_owned();
    assert!(error().contains("RAPID_TOPIC is not set"), "{}", error());
    // SAFETY: the header permits null for both.
    assert_eq!(unsafe { rapid_node_publish(node, std::ptr::null()) }, -1);
    assert_eq!(error(), "no node or no sample");
    // SAFETY: likewise.
    unsafe { rapid_node_close(node) };
}
