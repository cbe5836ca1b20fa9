//! A complete bundle for tests.

#![allow(clippy::unwrap_used, reason = "what fails here fails a test")]
#![allow(dead_code, reason = "each crate uses a part of it")]

use std::path::Path;

use rapid_core::text::hexadecimal;
use serde_json::{Value, json};
use sha2::{Digest, Sha256};

use rapid_policy::bundle::{Bundle, POLICY_FILE};

/// The text of a valid `policy.json`: two cameras of 96x96, of which one is tactile, and an arm of
/// four numbers; 10 DDIM steps.
pub(crate) const POLICY: &str = include_str!("../bundle/valid/tactile.json");

/// Writes a bundle with these graphs into `folder`, which must exist, and loads it.
pub(crate) fn write(folder: &Path, encoder: &[u8], denoiser: &[u8]) -> Bundle {
    write_changed(folder, encoder, denoiser, |_| {})
}

/// The same with a change to `policy.json`.
pub(crate) fn write_changed(folder: &Path, encoder: &[u8], denoiser: &[u8], change: impl FnOnce(&mut Value)) -> Bundle {
    let mut policy: Value = serde_json::from_str(POLICY).unwrap();
    for (key, bytes) in [("encoder", encoder), ("denoiser", denoiser)] {
        let file = format!("{key}.onnx");
        std::fs::write(folder.join(&file), bytes).unwrap();
        let sha256 = hexadecimal(&Sha256::digest(bytes));
        policy["graphs"][key] = json!({"file": file, "sha256": sha256});
    }
    change(&mut policy);
    std::fs::write(folder.join(POLICY_FILE), serde_json::to_string_pretty(&policy).unwrap()).unwrap();
    Bundle::load(folder).unwrap_or_else(|errors| panic!("{errors}"))
}
