//! Times of the stages of some work, by their `tracing` spans.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use burn::tensor::Device;
use tracing::span::Id;
use tracing::subscriber::with_default;
use tracing::{Subscriber, span};
use tracing_subscriber::layer::{Context, Layer, SubscriberExt};
use tracing_subscriber::registry::{LookupSpan, Registry};

/// All spans of one name.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Stage {
    /// Their name.
    pub name: &'static str,
    /// Time in them, excluding nested spans.
    pub own: Duration,
    /// Time in them, including nested spans.
    pub whole: Duration,
}

/// Spans that have ended since the last `take`, in the order in which their names first ended.
#[derive(Debug, Clone, Default)]
pub struct Recording {
    spans: Arc<Mutex<Spans>>,
    /// Device to wait for at the start and end of spans.
    device: Option<Device>,
}

#[derive(Debug, Default)]
struct Spans {
    open: Vec<Open>,
    stages: Vec<Stage>,
    most_in_use: u64,
}

#[derive(Debug)]
struct Open {
    name: &'static str,
    start: Instant,
    inside: Duration,
}

impl Recording {
    /// Records the spans of `work` on this thread. Spans on other threads count towards the span
    /// that waits for them.
    pub fn of<R>(work: impl FnOnce(&Self) -> R) -> R {
        let recording = Self::default();
        let subscriber = Registry::default().with(recording.clone());
        with_default(subscriber, || work(&recording))
    }

    /// [`of`](Self::of) for a device that works asynchronously: each span begins and ends with an
    /// idle device, so the total loses any overlap.
    pub fn on_device<R>(device: &Device, work: impl FnOnce(&Self) -> R) -> R {
        let recording = Self {
            device: Some(device.clone()),
            ..Self::default()
        };
        let subscriber = Registry::default().with(recording.clone());
        with_default(subscriber, || work(&recording))
    }

    /// Peak bytes in use at the start or end of a span, by the device's own count; zero without a
    /// counting device.
    pub fn most_in_use(&self) -> u64 {
        self.spans().most_in_use
    }

    /// Waits until the device is idle.
    fn settle(&self) {
        let Some(device) = &self.device else { return };
        // A failed device reports its error again to whoever requests a result.
        let _ = device.sync();
        if let Some(usage) = device.memory_pool_usage() {
            let mut spans = self.spans();
            spans.most_in_use = spans.most_in_use.max(usage.bytes_in_use);
        }
    }

    /// Returns the recorded stages and starts anew.
    pub fn take(&self) -> Vec<Stage> {
        core::mem::take(&mut self.spans().stages)
    }

    fn spans(&self) -> std::sync::MutexGuard<'_, Spans> {
        self.spans.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl<S: Subscriber + for<'a> LookupSpan<'a>> Layer<S> for Recording {
    fn on_enter(&self, id: &span::Id, context: Context<'_, S>) {
        let name = context.metadata(id).map_or("", |metadata| metadata.name());
        self.settle();
        self.spans().open.push(Open {
            name,
            start: Instant::now(),
            inside: Duration::ZERO,
        });
    }

    fn on_exit(&self, _: &Id, _: Context<'_, S>) {
        self.settle();
        let mut spans = self.spans();
        let Some(open) = spans.open.pop() else {
            return;
        };
        let whole = open.start.elapsed();
        let own = whole.saturating_sub(open.inside);
        if let Some(outer) = spans.open.last_mut() {
            outer.inside += whole;
        }
        match spans
            .stages
            .iter_mut()
            .find(|stage| stage.name == open.name)
        {
            Some(stage) => {
                stage.own += own;
                stage.whole += whole;
            }
            None => spans.stages.push(Stage {
                name: open.name,
                own,
                whole,
            }),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::thread::sleep;

    use tracing::trace_span;

    use super::*;

    #[test]
    fn time_belongs_to_the_innermost_span() {
        let pause = Duration::from_millis(20);
        let (first, second) = Recording::of(|recording| {
            trace_span!("outer").in_scope(|| {
                sleep(pause);
                for _ in 0..2 {
                    trace_span!("middle").in_scope(|| {
                        sleep(pause);
                        trace_span!("inner").in_scope(|| sleep(pause));
                    });
                }
            });
            (recording.take(), recording.take())
        });
        assert_eq!(second, []);
        let names: Vec<_> = first.iter().map(|stage| stage.name).collect();
        assert_eq!(names, ["inner", "middle", "outer"]);
        let [inner, middle, outer] = first[..] else {
            panic!()
        };
        assert!(inner.own >= 2 * pause && inner.own == inner.whole);
        assert!(middle.own >= 2 * pause && outer.own >= pause);
        assert_eq!(middle.own + inner.whole, middle.whole);
        assert_eq!(outer.own + middle.whole, outer.whole);
    }

    #[test]
    fn only_what_is_recorded_is_heard() {
        let unheard = trace_span!("outside");
        assert!(unheard.is_disabled());
        Recording::of(|_| assert!(!trace_span!("inside").is_disabled()));
        assert!(trace_span!("outside").is_disabled());
    }
}
