//! Time from the start of the program until a policy is loaded, and until its first action.

use std::process::Command;
use std::time::Instant;

use crate::figure::Figure;
use crate::load::kind;
use crate::process::Running;
use crate::start::{ms, to_mask};
use crate::stats::Sorted;
use crate::{Bench, Failure, LIMIT};

pub(crate) fn measure(bench: &Bench) -> Result<Vec<Figure>, Failure> {
    let starts = bench.choose(20, 3);
    let (mut loaded, mut acting, mut masks) = (Vec::new(), Vec::new(), Vec::new());
    for start in 0..starts {
        bench.progress(&format!("infer: {start} of {starts}"));
        masks.push(to_mask(bench, &["--sim", "task"])?);
        let [policy, act] = to_policy(bench)?;
        loaded.push(policy);
        acting.push(act);
    }
    let [loaded, acting, masks] = [loaded, acting, masks].map(Sorted::new);
    let note = format!(
        "{starts} starts of `rapid --infer --sim task --headless --json`, until its event `policy`; baseline: without \
         --infer, until its first mask"
    );
    Ok(vec![
        Figure::new("infer/policy loaded, p50", "ms", loaded.quantile(0.5))
            .baseline(masks.quantile(0.5))
            .target("< 400")
            .note(note),
        Figure::new("infer/policy loaded, max", "ms", loaded.max()).baseline(masks.max()),
        Figure::new("infer/first action, p50", "ms", acting.quantile(0.5)).note("until its event `act`"),
    ])
}

/// Time from the start to the events `policy` and `act`, ms.
fn to_policy(bench: &Bench) -> Result<[f64; 2], Failure> {
    let mut command = Command::new(&bench.rapid);
    command.arg("--infer").arg(&bench.bundle);
    command.args(["--sim", "task", "--headless", "--json"]);
    command.args(["--instance", &format!("bench-infer-{}", std::process::id())]);
    let begun = Instant::now();
    let mut program = Running::start(&mut command)?;
    program.wait_for(LIMIT, |line| kind(line).as_deref() == Some("policy"))?;
    let policy = ms(begun);
    program.wait_for(LIMIT, |line| kind(line).as_deref() == Some("act"))?;
    let act = ms(begun);
    program.stop()?;
    Ok([policy, act])
}
