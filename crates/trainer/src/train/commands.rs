//! Commands to a run from another thread, between its steps.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, TryRecvError, channel};
use std::time::Duration;

use splat_data::SplatData;

/// How often a paused run looks whether it was interrupted.
const PAUSED_POLL: Duration = Duration::from_millis(50);

/// What a run can be told between its steps.
#[derive(Debug)]
pub enum Command {
    /// Wait before the next step.
    Pause,
    /// Go on.
    Resume,
    /// Take one step, and wait again.
    Step,
    /// Keep a checkpoint now, where checkpoints are kept.
    Save,
    /// End after this step, as an interrupt does.
    Stop,
    /// Send the scene as it is.
    Snapshot(Sender<Snapshot>),
}

/// A scene in the middle of a run.
#[derive(Debug, Clone, PartialEq)]
pub struct Snapshot {
    /// Steps done.
    pub step: usize,
    /// The scene, with the settings that it is rendered with.
    pub scene: SplatData,
}

/// Where commands to a run are put: one end for whoever watches, the other for
/// [`TrainerBuilder::commands`](super::TrainerBuilder::commands).
pub fn command_queue() -> (Sender<Command>, Receiver<Command>) {
    channel()
}

/// What the run is to do now.
pub(super) enum Next {
    Step,
    Stop,
    Save,
    Snapshot(Sender<Snapshot>),
}

/// The receiving end, and whether the run waits.
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

    /// The next thing to do, waiting for it while the run is paused. A queue whose other end is
    /// gone commands nothing: the run goes on.
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
