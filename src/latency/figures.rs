// SPDX-License-Identifier: GPL-3.0-or-later
//! The document of `pinion latency --json`.

use std::path::Path;

use pinion_firmware::lateness::{Lateness, us};
use pinion_runtime::latency::{Assessment, Fitness, Half};
use pinion_system::files;
use serde::{Deserialize, Serialize};

use super::computer_name;

/// The version of the document. Later versions may add keys.
const FORM: u32 = 1;
/// Largest document that is read, in MiB.
const MIB_MAX: u64 = 1;

/// The figures of a computer: its latency, or with `--pin` the cost of an edge.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Figures {
    form: u32,
    /// Pinion's version.
    version: String,
    /// The computer's model and kernel.
    pub computer: String,
    /// How late the computer is.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub latency: Option<Latency>,
    /// The cost of an edge of a GPIO line.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub edge: Option<EdgeCost>,
}

/// How late a computer is, and the uses that this allows.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Latency {
    /// Everything.
    pub fit_for_steppers: bool,
    /// Heaters, fans and other outputs that change seldom.
    pub fit_for_slow_outputs: bool,
    /// The figure that decided.
    pub why: String,
    /// Without other load.
    pub idle: HalfFigures,
    /// With load on all processors.
    pub under_load: HalfFigures,
}

/// Half of a measurement.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct HalfFigures {
    wakeups: LateUs,
    /// How late an output would change.
    pub edges: LateUs,
    margin_us: f64,
}

/// How late events were, in microseconds.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct LateUs {
    events: u64,
    p50: f64,
    p99: f64,
    /// 999 of 1000 were at most this late.
    pub p999: f64,
    max: f64,
}

/// The cost of an edge of a GPIO line, in nanoseconds.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct EdgeCost {
    pub(super) line: String,
    /// Through the kernel.
    pub kernel_ns: Option<f64>,
    /// Through the chip's registers, if that is possible.
    pub registers_ns: Option<f64>,
}

impl Figures {
    pub(super) fn of_latency(halves: &[Half; 2], verdict: &Assessment) -> Figures {
        let [idle, under_load] = halves.each_ref().map(HalfFigures::of);
        let latency = Latency {
            fit_for_steppers: verdict.fitness == Fitness::Steppers,
            fit_for_slow_outputs: verdict.fitness != Fitness::Nothing,
            why: verdict.why.clone(),
            idle,
            under_load,
        };
        Figures { latency: Some(latency), ..Figures::of_edge(None) }
    }

    pub(super) fn of_edge(edge: Option<EdgeCost>) -> Figures {
        let version = env!("CARGO_PKG_VERSION").to_owned();
        Figures { form: FORM, version, computer: computer_name(), latency: None, edge }
    }

    /// Reads a document.
    ///
    /// # Errors
    ///
    /// The file cannot be read, or is another document.
    pub fn read(path: &Path) -> Result<Figures, String> {
        let bytes = files::read(path, MIB_MAX).map_err(|error| format!("{}: {error}", path.display()))?;
        let refused = |why: &str| format!("{}: {why}: name an output of \"pinion latency --json\"", path.display());
        let figures: Figures = serde_json::from_slice(&bytes).map_err(|error| refused(&error.to_string()))?;
        match figures {
            Figures { latency: None, edge: None, .. } => Err(refused("it has no figures")),
            figures => Ok(figures),
        }
    }

    pub(super) fn json(&self) -> Result<String, String> {
        serde_json::to_string_pretty(self).map(|text| text + "\n").map_err(|error| error.to_string())
    }
}

impl HalfFigures {
    fn of(half: &Half) -> HalfFigures {
        HalfFigures { wakeups: LateUs::of(&half.wakeup), edges: LateUs::of(&half.edge), margin_us: us(half.margin) }
    }
}

impl LateUs {
    fn of(lateness: &Lateness) -> LateUs {
        let [p50, p99, p999] = [0.5, 0.99, 0.999].map(|share| us(lateness.quantile(share)));
        LateUs { events: lateness.samples(), p50, p99, p999, max: us(lateness.max()) }
    }
}
