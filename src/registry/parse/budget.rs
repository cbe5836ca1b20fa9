//! How many samples each topic keeps, within the rig's shared memory.

use super::device::Draft;
use crate::registry::diagnostic::Diagnostic;
use crate::registry::section::Problems;
use crate::registry::spec::{POOL_SPARE, RESERVED_BYTES, SAMPLE_OVERHEAD};
use crate::registry::units::show_size;

/// Fewer pictures than this cannot cover the pauses of a writer.
const LEAST_CAMERA_DEPTH: u64 = 8;

/// Lowers the default depths of cameras, all in proportion, until the topics fit into `budget`.
/// Depths written in the file stay. Too much even so is a problem that names the largest topics.
/// Returns what was lowered, as warnings.
pub(super) fn fit(
    drafts: &mut [Draft<'_>],
    budget: u64,
    rig_at: usize,
    problems: &mut Problems<'_>,
) -> Vec<Diagnostic> {
    let scaled = |draft: &Draft<'_>, permille: u64| {
        if draft.depth_written || !draft.is_camera() {
            return draft.depth;
        }
        // Depths are at most 4096: no overflow.
        (draft.depth * permille / 1000).max(LEAST_CAMERA_DEPTH)
    };
    let total = |drafts: &[Draft<'_>], permille| -> u64 {
        drafts.iter().map(|draft| pool(draft, scaled(draft, permille))).fold(RESERVED_BYTES, u64::saturating_add)
    };
    if total(drafts, 0) > budget {
        report(drafts, total(drafts, 0), budget, rig_at, problems);
        return Vec::new();
    }
    let permille = (0..=1000).rev().find(|permille| total(drafts, *permille) <= budget).unwrap_or(0);
    let mut warnings = Vec::new();
    for draft in drafts {
        let depth = scaled(draft, permille);
        if depth < draft.depth {
            let message = format!(
                "depth lowered from {} to {depth} to keep all topics within memory_budget = {}",
                draft.depth,
                show_size(budget)
            );
            let fix = format!("write depth = {depth}, a smaller max_bytes, or a larger memory_budget in [rig]");
            warnings.push(problems.diagnostic(draft.section.at, &draft.section.entry, message, fix));
        }
        draft.depth = depth;
    }
    warnings
}

/// Shared memory that the topic of `draft` takes with this depth, in bytes.
fn pool(draft: &Draft<'_>, depth: u64) -> u64 {
    let sample = draft.max_bytes.saturating_add(SAMPLE_OVERHEAD as u64);
    sample.saturating_mul(depth + POOL_SPARE as u64)
}

fn report(drafts: &[Draft<'_>], total: u64, budget: u64, rig_at: usize, problems: &mut Problems<'_>) {
    let size = |draft: &Draft<'_>| {
        let depth = if draft.depth_written || !draft.is_camera() { draft.depth } else { LEAST_CAMERA_DEPTH };
        (pool(draft, depth), depth)
    };
    let mut largest: Vec<_> = drafts.iter().map(|draft| (size(draft), draft)).collect();
    largest.sort_by_key(|((bytes, _), _)| std::cmp::Reverse(*bytes));
    let named: Vec<String> = largest
        .iter()
        .take(3)
        .map(|((bytes, depth), draft)| {
            let samples = depth + POOL_SPARE as u64;
            format!("{} {} ({} x {samples})", draft.name, show_size(*bytes), show_size(draft.max_bytes))
        })
        .collect();
    let message = format!(
        "the topics need {} of shared memory, more than memory_budget = {}; largest: {}",
        show_size(total),
        show_size(budget),
        named.join(", ")
    );
    let fix = "lower max_bytes, depth or the pictures' size of these, or raise memory_budget in [rig]";
    problems.report(rig_at, "rig", message, fix);
}
