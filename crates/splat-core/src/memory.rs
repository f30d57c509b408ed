//! Memory available to this process. Work that needs more is refused with an error, since a failed
//! allocation would end the process.

use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::time::{Duration, Instant};

/// How long a measurement stays valid for small needs.
const FRESH: Duration = Duration::from_secs(1);
/// Inverse share of the memory left above which a need triggers a new measurement.
const LARGE_SHARE: u64 = 4;
/// Inverse share of the memory left that is not counted on: gaps between large allocations may be
/// too small for the next one.
const SLACK_SHARE: u64 = 8;
/// Memory left for other allocations in the meantime.
const RESERVE: u64 = 128 << 20;

/// Bytes that this process can still allocate: the minimum of what the system has left, of what its
/// control groups may still use, and of what its own limits (`ulimit -v`, `ulimit -d`) leave.
/// `None` on systems other than Linux, which do not report it.
pub fn available_memory() -> Option<u64> {
    let read = |path: &Path| std::fs::read_to_string(path).ok();
    let proc = |file: &str| read(&Path::new("/proc").join(file));
    let status = proc("self/status").unwrap_or_default();
    let limits = proc("self/limits").unwrap_or_default();
    let meminfo = proc("meminfo").unwrap_or_default();
    let groups = proc("self/cgroup").unwrap_or_default();
    [
        kilobytes(&meminfo, "MemAvailable:"),
        left(limit(&limits, "Max address space"), mapped(&status)),
        left(limit(&limits, "Max data size"), mapped(&status)),
        left_in_groups(&groups, &read),
    ]
    .into_iter()
    .flatten()
    .min()
}

/// The memory that can be counted on, if `needed` bytes exceed it. Small needs reuse the last
/// measurement, and tiny ones are always granted: a brief shortage should not end a run.
pub fn lacking(needed: u64) -> Option<u64> {
    if needed <= RESERVE / 2 {
        return None;
    }
    static LAST: Mutex<Option<(Instant, Option<u64>)>> = Mutex::new(None);
    let mut last = LAST.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
    let known = last.filter(|(at, left)| {
        at.elapsed() < FRESH && left.is_none_or(|left| needed <= left / LARGE_SHARE)
    });
    let (at, left) = known.unwrap_or_else(|| (Instant::now(), available_memory()));
    let usable = left.map(|left| (left - left / SLACK_SHARE).saturating_sub(RESERVE));
    let lacking = usable.filter(|usable| needed > *usable);
    // Memory granted now is not available to the next caller.
    let granted = if lacking.is_none() { needed } else { 0 };
    *last = Some((at, left.map(|left| left.saturating_sub(granted))));
    lacking
}

/// Formats a size for messages.
pub fn in_units(bytes: u64) -> String {
    match bytes as f64 {
        bytes if bytes >= 1e9 => format!("{:.1} GB", bytes / 1e9),
        bytes => format!("{:.0} MB", bytes / 1e6),
    }
}

/// Address space in use, from a process's `status`. `VmSize` and `VmData` include memory that an
/// allocator has reserved but not touched, and will hand out later.
fn mapped(status: &str) -> Option<u64> {
    let parts = ["RssAnon:", "VmStk:", "VmExe:", "VmLib:"];
    parts.iter().map(|part| kilobytes(status, part)).sum()
}

fn left(limit: Option<u64>, used: Option<u64>) -> Option<u64> {
    Some(limit?.saturating_sub(used.unwrap_or(0)))
}

/// The value of a line `NAME   123 kB`, in bytes.
fn kilobytes(text: &str, name: &str) -> Option<u64> {
    let line = text.lines().find_map(|line| line.strip_prefix(name))?;
    let value: u64 = line.split_whitespace().next()?.parse().ok()?;
    value.checked_mul(1024)
}

/// The soft limit in a line of `/proc/self/limits`; `None` if `unlimited`.
fn limit(limits: &str, name: &str) -> Option<u64> {
    let line = limits.lines().find_map(|line| line.strip_prefix(name))?;
    line.split_whitespace().next()?.parse().ok()
}

/// Memory that the control groups of this process (`/proc/self/cgroup`), and their parents, may
/// still use.
fn left_in_groups(groups: &str, read: &dyn Fn(&Path) -> Option<String>) -> Option<u64> {
    let left = groups.lines().filter_map(|line| {
        let [_, controllers, path] = line.splitn(3, ':').collect::<Vec<_>>().try_into().ok()?;
        let (root, names) = match controllers {
            "" => (
                "/sys/fs/cgroup",
                ["memory.max", "memory.current", "inactive_file "],
            ),
            _ if controllers.split(',').any(|name| name == "memory") => (
                "/sys/fs/cgroup/memory",
                [
                    "memory.limit_in_bytes",
                    "memory.usage_in_bytes",
                    "total_inactive_file ",
                ],
            ),
            _ => return None,
        };
        let group = Path::new(root).join(path.trim_start_matches('/'));
        let folders = group
            .ancestors()
            .take_while(|folder| folder.starts_with(root));
        folders
            .filter_map(|folder| left_in_group(folder.to_path_buf(), names, read))
            .min()
    });
    left.min()
}

/// Memory that one group may still use: its limit minus its usage, without reclaimable file cache.
fn left_in_group(
    folder: PathBuf,
    [max, current, files]: [&str; 3],
    read: &dyn Fn(&Path) -> Option<String>,
) -> Option<u64> {
    let number = |text: &str| text.trim().parse::<u64>().ok();
    let max = number(&read(&folder.join(max))?)?;
    let used = read(&folder.join(current))
        .and_then(|text| number(&text))
        .unwrap_or(0);
    let stat = read(&folder.join("memory.stat")).unwrap_or_default();
    let cached = stat
        .lines()
        .find_map(|line| number(line.strip_prefix(files)?));
    Some(max.saturating_sub(used.saturating_sub(cached.unwrap_or(0))))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn limits_are_read_as_the_system_writes_them() {
        let limits = "Limit                     Soft Limit           Hard Limit           Units     \n\
                      Max data size             unlimited            unlimited            bytes     \n\
                      Max address space         1536000000           unlimited            bytes     \n";
        assert_eq!(limit(limits, "Max address space"), Some(1_536_000_000));
        assert_eq!(limit(limits, "Max data size"), None);
        let status =
            "VmSize:\t 99 kB\nRssAnon:\t 1200 kB\nVmStk:\t 30 kB\nVmExe:\t 4 kB\nVmLib:\t 100 kB\n";
        assert_eq!(mapped(status), Some(1_334 * 1024));
        assert_eq!(mapped("RssAnon:\t 1200 kB\n"), None);
        assert_eq!(left(Some(5), Some(7)), Some(0));
    }

    #[test]
    fn the_tightest_group_counts_without_its_cached_files() {
        let files = |path: &Path| {
            let text = match path.to_str()? {
                "/sys/fs/cgroup/a/memory.max" => "1000\n",
                "/sys/fs/cgroup/a/memory.current" => "600\n",
                "/sys/fs/cgroup/a/memory.stat" => "anon 300\ninactive_file 200\n",
                "/sys/fs/cgroup/a/b/memory.max" => "max\n",
                "/sys/fs/cgroup/a/b/memory.current" => "400\n",
                "/sys/fs/cgroup/memory/c/memory.limit_in_bytes" => "500",
                "/sys/fs/cgroup/memory/c/memory.usage_in_bytes" => "100",
                _ => return None,
            };
            Some(text.to_owned())
        };
        assert_eq!(left_in_groups("0::/a/b\n", &files), Some(600));
        assert_eq!(
            left_in_groups("3:cpu,memory:/c\n0::/a/b\n", &files),
            Some(400)
        );
        assert_eq!(left_in_groups("0::/\n2:cpu:/x\nnonsense\n", &files), None);
    }

    #[test]
    fn sizes_are_short() {
        assert_eq!(in_units(2_448_000_000), "2.4 GB");
        assert_eq!(in_units(3_400_000), "3 MB");
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn more_than_there_is_is_lacking() {
        assert!(available_memory().is_some_and(|left| left > RESERVE));
        assert_eq!(lacking(1), None);
        assert!(lacking(u64::MAX).is_some());
    }
}
