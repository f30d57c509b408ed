//! Commands to a run from another thread, executed between steps.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, TryRecvError, channel};
use std::time::Duration;

use splat_data::SplatData;

/// Interval at which a paused run checks for interruption.
const PAUSED_POLL: Duration = Duration::from_millis(50);

/// A command to a run, executed between steps.
#[derive(Debug)]
pub enum Command {
    /// Waits before the next step.
    Pause,
    /// Continues.
    Resume,
    /// Takes one step, then waits again.
    Step,
    /// Writes a checkpoint now, to the usual place.
    Save,
    /// Ends after this step, like an interrupt.
    Stop,
    /// Sends the current scene.
    Snapshot(Sender<Snapshot>),
}

/// The scene of a running training.
#[derive(Debug, Clone, PartialEq)]
pub struct Snapshot {
    /// Steps done.
    pub step: usize,
    /// The scene, with its render settings.
    pub scene: SplatData,
}

/// A channel for commands: the sender for the controlling thread, the receiver for
/// [`TrainerBuilder::commands`](super::TrainerBuilder::commands).
pub fn command_queue() -> (Sender<Command>, Receiver<Command>) {
    channel()
}

/// The next action of a run.
pub(super) enum Next {
    Step,
    Stop,
    Save,
    Snapshot(Sender<Snapshot>),
}

/// The receiver, and whether the run is paused.
pub(super) struct Commands {
    receiver: Option<Receiver<Command>>,
    paused: bool,
}

impl Commands {
    pub(super) fn new(receiver: Option<Receiver<Command>>) -> Self {
        Self {
            receiver,
            paused: false,
        }
    }

    /// The next action, waiting for it while paused. If all senders are gone, the run continues.
    pub(super) fn next(&mut self, interrupt: &AtomicBool) -> Next {
        loop {
            if interrupt.load(Ordering::Relaxed) {
                return Next::Stop;
            }
            let Some(receiver) = &self.receiver else {
                return Next::Step;
            };
            let command = match self.paused {
                true => receiver.recv_timeout(PAUSED_POLL),
                false => receiver.try_recv().map_err(|error| match error {
                    TryRecvError::Empty => RecvTimeoutError::Timeout,
                    TryRecvError::Disconnected => RecvTimeoutError::Disconnected,
                }),
            };
            match command {
                Ok(Command::Pause) => self.paused = true,
                Ok(Command::Resume) => self.paused = false,
                Ok(Command::Step) => {
                    self.paused = true;
                    return Next::Step;
                }
                Ok(Command::Save) => return Next::Save,
                Ok(Command::Stop) => return Next::Stop,
                Ok(Command::Snapshot(to)) => return Next::Snapshot(to),
                Err(RecvTimeoutError::Timeout) if self.paused => {}
                Err(RecvTimeoutError::Timeout) => return Next::Step,
                Err(RecvTimeoutError::Disconnected) => self.receiver = None,
            }
        }
    }
}
