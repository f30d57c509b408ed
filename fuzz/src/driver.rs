//! The fuzzing loop: mutate, run, judge, and keep inputs that reach something new.

use std::cell::Cell;
use std::collections::HashSet;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::io::{Seek, Write};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::PathBuf;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Weak};
use std::time::Duration;

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use crate::coverage::{self, Edges, Reached};
use crate::formats::{Input, Target};
use crate::memory::peak_of;
use crate::mutate;

/// Time after which an input counts as hanging.
const LONGEST: Duration = Duration::from_secs(60);
/// Longest input in bytes: faults that need longer ones usually start with small ones.
const LARGEST: usize = 1 << 16;
/// Most inputs kept for further mutation.
const CORPUS: usize = 4_096;

/// Statistics of a campaign.
#[derive(Debug, Clone, Default)]
pub struct Report {
    /// Inputs run.
    pub executions: u64,
    /// Inputs accepted by the reader.
    pub accepted: u64,
    /// Accepted inputs passed on to the next stage.
    pub followed: u64,
    /// Passed-on inputs that the next stage accepted.
    pub taken: u64,
    /// Distinct outcomes: messages without numbers and quotations.
    pub outcomes: usize,
    /// Inputs kept.
    pub corpus: usize,
    /// Branches, if they are counted.
    pub edges: Edges,
    /// Largest peak of memory beyond the constant, relative to the input's length.
    pub memory: f64,
}

/// An input that fails, and how.
#[derive(Debug)]
pub struct Failed {
    /// The reason.
    pub reason: String,
    /// The input's files.
    pub files: Vec<PathBuf>,
}

impl std::fmt::Display for Failed {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}; the input is {:?}", self.reason, self.files)
    }
}

/// A running campaign of a target.
pub struct Campaign {
    target: &'static Target,
    rng: Pcg64Mcg,
    /// The seeds, and inputs that reached something new.
    corpus: Vec<Input>,
    seeds: usize,
    /// Inputs of the corpus that the reader accepts.
    valid: Vec<usize>,
    reached: Reached,
    outcomes: HashSet<u64>,
    watch: Watch,
    /// Statistics so far.
    pub report: Report,
}

impl Campaign {
    /// Starts with the target's seeds, run unmodified.
    ///
    /// # Errors
    /// When a seed fails or is refused; it would be useless as a start.
    pub fn new(target: &'static Target, seed: u64) -> Result<Self, Failed> {
        let mut campaign = Self {
            target,
            rng: Pcg64Mcg::seed_from_u64(seed),
            corpus: vec![],
            seeds: 0,
            valid: vec![],
            reached: Reached::default(),
            outcomes: HashSet::new(),
            watch: Watch::new(target.name),
            report: Report::default(),
        };
        for input in (target.seeds)() {
            let (accepted, taken) = (campaign.report.accepted, campaign.report.taken);
            campaign.execute(&input, true)?;
            if campaign.report.accepted == accepted {
                return Err(campaign.failed("a seed is refused".into(), &input));
            }
            if campaign.report.taken == taken {
                return Err(campaign.failed("a seed is let through, but of no use".into(), &input));
            }
            campaign.valid.push(campaign.corpus.len());
            campaign.corpus.push(input);
        }
        campaign.seeds = campaign.corpus.len();
        Ok(campaign)
    }

    /// Runs one new input.
    ///
    /// # Errors
    /// When the input fails.
    pub fn step(&mut self) -> Result<(), Failed> {
        // A broken input seldom becomes valid again: two of three mutations start from a valid one.
        let at = match self.rng.random_range(0..3) {
            0 => mutate::place(&mut self.rng, self.seeds),
            1 => *mutate::one_of(&mut self.rng, &self.valid),
            _ => mutate::place(&mut self.rng, self.corpus.len()),
        };
        let mut input = self.corpus[at].clone();
        let more = self.rng.random_bool(0.5);
        for _ in 0..if more {
            self.rng.random_range(2..=5)
        } else {
            1
        } {
            self.mutate(&mut input);
        }
        for part in &mut input.0 {
            part.truncate(LARGEST);
        }
        let accepted = self.report.accepted;
        if self.execute(&input, false)? && self.corpus.len() < CORPUS {
            if self.report.accepted > accepted {
                self.valid.push(self.corpus.len());
            }
            self.corpus.push(input);
        }
        self.report.corpus = self.corpus.len();
        Ok(())
    }

    fn mutate(&mut self, input: &mut Input) {
        let rng = &mut self.rng;
        if rng.random_bool(0.7) {
            (self.target.mutate)(input, rng);
        } else if rng.random_bool(0.1) {
            let other = mutate::one_of(rng, &self.corpus);
            let at = mutate::place(rng, input.0.len());
            input.0[at].clone_from(&other.0[at]);
        } else {
            let at = mutate::place(rng, input.0.len());
            mutate::bytes(&mut input.0[at], rng);
        }
    }

    /// Runs an input; returns true if it did something new. Accepted inputs are passed on
    /// sometimes, or `always`.
    ///
    /// # Errors
    /// When the input fails.
    pub fn execute(&mut self, input: &Input, always: bool) -> Result<bool, Failed> {
        self.watch.begin(input);
        self.report.executions += 1;
        coverage::clear();
        let (parsed, peak) = peak_of(|| catch_unwind(|| (self.target.parse)(input)));
        let news = self.reached.add();
        let Ok(parsed) = parsed else {
            return Err(self.failed("the reader panics".into(), input));
        };
        let len: usize = input.0.iter().map(Vec::len).sum();
        let memory = &self.target.memory;
        let per_byte = peak.saturating_sub(memory.constant) as f64 / len.max(1) as f64;
        self.report.memory = self.report.memory.max(per_byte);
        if per_byte > memory.per_byte as f64 {
            let reason = format!(
                "the reader takes {peak} bytes for {len}, more than {} a byte and {}",
                memory.per_byte, memory.constant
            );
            return Err(self.failed(reason, input));
        }
        let (outcome, follow) = match parsed {
            Ok(follow) => ("accepted".to_owned(), Some(follow)),
            Err(message) => (message, None),
        };
        if follow.is_none() && !outcome.contains(self.target.file) {
            return Err(self.failed(format!("`{outcome}` does not name the file"), input));
        }
        let outcome_is_new = self.outcomes.insert(hash_of(&gist(&outcome)));
        let news = if coverage::is_counted() {
            news
        } else {
            outcome_is_new
        };
        self.report.outcomes = self.outcomes.len();
        if let Some(follow) = follow {
            self.report.accepted += 1;
            if always || hash_of(&input.0).is_multiple_of(self.target.follow_every) {
                self.report.followed += 1;
                match catch_unwind(AssertUnwindSafe(follow)) {
                    Ok(taken) => self.report.taken += u64::from(taken),
                    Err(_) => {
                        let reason = "what the reader lets through panics".into();
                        return Err(self.failed(reason, input));
                    }
                }
            }
        }
        self.watch.end();
        Ok(news)
    }

    /// The report, including branches.
    pub fn finish(mut self) -> Report {
        self.report.edges = self.reached.edges();
        self.report
    }

    fn failed(&self, reason: String, input: &Input) -> Failed {
        let folder = PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/failures"));
        let name = format!("{}-{:016x}", self.target.name, hash_of(&input.0));
        let files: Vec<_> = (0..input.0.len())
            .map(|part| folder.join(format!("{name}.{part}")))
            .collect();
        let written = std::fs::create_dir_all(&folder).and_then(|()| {
            let mut parts = files.iter().zip(&input.0);
            parts.try_for_each(|(file, part)| std::fs::write(file, part))
        });
        let place = written
            .err()
            .map_or_else(String::new, |e| format!(" (not written: {e})"));
        Failed {
            reason: format!(
                "{}: {reason}, at execution {}{place}",
                self.target.name, self.report.executions
            ),
            files,
        }
    }
}

/// End of a message without the parts that differ between inputs: numbers and quotations.
fn gist(message: &str) -> String {
    let outside: Vec<&str> = message.split(['`', '\'']).step_by(2).collect();
    let words = outside.concat();
    let letters: Vec<char> = words.chars().filter(|c| c.is_alphabetic()).collect();
    letters[letters.len().saturating_sub(60)..].iter().collect()
}

fn hash_of(value: &impl Hash) -> u64 {
    let mut hasher = DefaultHasher::new();
    value.hash(&mut hasher);
    hasher.finish()
}

/// Keeps the current input in a file, which survives an abort, and ends the process if the input
/// hangs.
struct Watch {
    path: PathBuf,
    file: Option<std::fs::File>,
    /// Number of the current input, from 1; 0 between inputs.
    present: Arc<AtomicU64>,
    count: Cell<u64>,
}

impl Watch {
    fn new(name: &'static str) -> Self {
        let path = std::env::temp_dir().join(format!("splat-fuzz-{name}-{}", std::process::id()));
        let present = Arc::new(AtomicU64::new(0));
        let watched = Arc::downgrade(&present);
        let file = std::fs::File::create(&path).ok();
        let watched_path = path.clone();
        std::thread::spawn(move || watch(&watched, &watched_path));
        Self {
            path,
            file,
            present,
            count: Cell::new(0),
        }
    }

    fn begin(&self, input: &Input) {
        self.count.set(self.count.get() + 1);
        self.present.store(self.count.get(), Ordering::Relaxed);
        if let Some(mut file) = self.file.as_ref() {
            let bytes = input.0.concat();
            // Without the file, an aborting failure can still be reproduced by its seed.
            let _ = file
                .rewind()
                .and_then(|()| file.write_all(&bytes))
                .and_then(|()| file.set_len(bytes.len() as u64));
        }
    }

    fn end(&self) {
        self.present.store(0, Ordering::Relaxed);
    }
}

/// Watches a campaign until it ends. Time is measured by polls, of which none happen while the
/// process is stopped.
fn watch(present: &Weak<AtomicU64>, path: &std::path::Path) {
    const PAUSE: Duration = Duration::from_millis(500);
    let (mut seen, mut time) = (0, Duration::ZERO);
    while let Some(now) = present.upgrade().map(|input| input.load(Ordering::Relaxed)) {
        time = match now {
            0 => Duration::ZERO,
            _ if now != seen => Duration::ZERO,
            _ => time + PAUSE,
        };
        seen = now;
        if time > LONGEST {
            eprintln!(
                "an input takes more than {LONGEST:?}; its parts, joined, are in {}",
                path.display()
            );
            std::process::exit(1);
        }
        std::thread::sleep(PAUSE);
    }
}

impl Drop for Watch {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.path);
    }
}
