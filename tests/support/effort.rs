//! How much is done of a test that tries thousands of cases.

/// Of the cases of such a test every so manyth is tried: every `n`th, and with `RAPID_THOROUGH` (`make test-all`) each.
pub(crate) fn every(n: usize) -> usize {
    if std::env::var_os("RAPID_THOROUGH").is_some() { 1 } else { n }
}
