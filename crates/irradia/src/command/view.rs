//! `irradia view`, and the viewer of `irradia train --view`.

use super::{DataArgs, thread_count, use_threads, warn};
use crate::interrupt::stop_flag;
use crate::terminal::{note, print_line};
use anyhow::Result;
use irradia_runs::Run;
use irradia_viewer::{DEFAULT_PORT, Listen, Subject, Viewer, Watcher};
use std::path::PathBuf;
use std::sync::atomic::Ordering;

#[derive(clap::Args)]
pub struct Args {
    /// What to view: RUN, a scene file, or a dataset
    pub path: PathBuf,
    /// Photographs to compare with; when absent those of the run
    #[arg(long)]
    pub data: Option<PathBuf>,
    #[command(flatten)]
    pub listen: ListenArgs,
    /// Threads; all cores when absent
    #[arg(long, value_name = "N", value_parser = thread_count())]
    pub threads: Option<usize>,
    #[command(flatten)]
    pub reading: DataArgs,
}

/// This machine alone.
const DEFAULT_HOST: &str = "127.0.0.1";

/// Where the page is served.
#[derive(Clone, Debug, clap::Args)]
pub struct ListenArgs {
    /// Address to serve the page on, such as 0.0.0.0 for other machines, which then need the token of the printed address
    #[arg(long, default_value = DEFAULT_HOST)]
    pub host: String,
    /// Port of the page; if it is taken, the next free one
    #[arg(long, default_value_t = DEFAULT_PORT)]
    pub port: u16,
    /// Open the page in a browser
    #[arg(long)]
    pub open: bool,
}

impl ListenArgs {
    /// Whether a host or port other than the default is requested.
    pub fn names_an_address(&self) -> bool {
        self.host != DEFAULT_HOST || self.port != DEFAULT_PORT
    }

    /// Serves `subject`, and prints the address.
    fn start(&self, subject: Subject) -> Result<Viewer> {
        warn(&subject.warnings);
        let listen = Listen {
            host: self.host.clone(),
            port: self.port,
            open: self.open,
        };
        let viewer = Viewer::start(subject, &listen, Box::new(|line| note(format_args!("viewer: {line}"))))?;
        print_line(format_args!("viewer: {}", viewer.address()))?;
        Ok(viewer)
    }

    /// Serves a running training.
    pub fn watch(&self, run: &Run) -> Result<(Viewer, Watcher)> {
        let (subject, watcher) = Subject::of_run(run);
        Ok((self.start(subject)?, watcher))
    }
}

pub fn run(args: &Args) -> Result<()> {
    use_threads(args.threads)?;
    let stop = stop_flag();
    let subject = Subject::open(&args.path, args.data.as_deref(), &args.reading.options())?;
    let viewer = args.listen.start(subject)?;
    note("press Ctrl-C to stop");
    viewer.wait(&|| stop.load(Ordering::Relaxed));
    Ok(())
}
