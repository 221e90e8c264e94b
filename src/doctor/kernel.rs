// SPDX-License-Identifier: GPL-3.0-or-later
//! The kernel: whether it is built and set up for real time.

use pinion_linux::gpio::{BIAS_SINCE, EDGES_SINCE, is_before};
use pinion_runtime::realtime::is_preempt_rt;
use pinion_system::Computer;
use pinion_system::finding::Finding;

use pinion_system::instance::Instance;

/// The oldest supported kernel: it opens a terminal whatever the terminal's permissions are (TIOCGPTPEER).
const OLDEST: (u32, u32) = (4, 13);

pub(super) fn findings(computer: &Computer, instances: &[Instance]) -> Vec<Finding> {
    let kernel = [version(computer), preempt_rt(computer), throttle(computer)].into_iter();
    kernel.chain(isolation(computer, instances)).chain(governor(computer)).collect()
}

/// Whether the kernel has everything that Pinion needs.
fn version(computer: &Computer) -> Finding {
    const CHECK: &str = "kernel_version";
    const REMEDY: &str = "update the system, or install a newer kernel";
    let release = computer.text("/proc/sys/kernel/osrelease").unwrap_or_default();
    let lacks = |version| is_before(&release, version);
    match () {
        () if lacks(OLDEST) => {
            let found = format!("Linux {release} is too old: Pinion needs {}.{} or later", OLDEST.0, OLDEST.1);
            Finding::error(CHECK, found, REMEDY)
        }
        () if lacks(BIAS_SINCE) => Finding::warning(
            CHECK,
            format!(
                "Linux {release} cannot switch pull-up and pull-down resistors on (5.5 can), and tachometers are polled (5.10 counts)"
            ),
            REMEDY,
        ),
        () if lacks(EDGES_SINCE) => {
            let found = format!("with Linux {release} tachometers are polled (5.10 counts their edges)");
            Finding::warning(CHECK, found, REMEDY)
        }
        () if release.is_empty() => Finding::ok(CHECK, "the kernel's version is unknown"),
        () => Finding::ok(CHECK, format!("Linux {release} has all that Pinion needs")),
    }
}

fn preempt_rt(computer: &Computer) -> Finding {
    const CHECK: &str = "preempt_rt";
    let release = computer.text("/proc/sys/kernel/osrelease").unwrap_or_else(|| "of unknown version".into());
    let install = match () {
        () if release.contains("rpi-v6") || release.contains("rpi-v7") => {
            "install a 64-bit Raspberry Pi OS, which has such a kernel (linux-image-rpi-v8-rt)"
        }
        () if release.contains("rpi") => "sudo apt install linux-image-rpi-v8-rt, and reboot",
        () if cfg!(target_arch = "x86_64") => "sudo apt install linux-image-rt-amd64, and reboot",
        () if cfg!(target_arch = "aarch64") => "sudo apt install linux-image-rt-arm64, and reboot",
        () => "sudo apt install linux-image-rt-armmp, and reboot",
    };
    match is_preempt_rt(&computer.path("/")) {
        Some(true) => Finding::ok(CHECK, format!("kernel {release} is PREEMPT_RT")),
        Some(false) => Finding::warning(
            CHECK,
            format!("kernel {release} is not PREEMPT_RT: steps may be late while other programs work"),
            format!("{install}; not needed where pinion latency says \"fit for steppers\""),
        ),
        None => Finding::ok(CHECK, "whether the kernel is PREEMPT_RT is unknown: there is no /proc/version"),
    }
}

fn throttle(computer: &Computer) -> Finding {
    const CHECK: &str = "rt_throttling";
    const REMEDY: &str = "sudo sysctl kernel.sched_rt_runtime_us=950000";
    let number =
        |name: &str| -> Option<i64> { computer.text(format!("/proc/sys/kernel/sched_rt_{name}_us"))?.parse().ok() };
    let (Some(runtime), Some(period)) = (number("runtime"), number("period")) else {
        return Finding::ok(
            CHECK,
            "whether the kernel throttles real time is unknown: there is no kernel.sched_rt_runtime_us",
        );
    };
    let found = format!("real time may take {runtime} of {period} us");
    match runtime {
        -1 => Finding::ok(CHECK, "the kernel does not throttle real time"),
        0 => Finding::error(CHECK, "the kernel permits no real time: kernel.sched_rt_runtime_us is 0", REMEDY),
        runtime if runtime < period / 2 => Finding::warning(CHECK, found, REMEDY),
        _ => Finding::ok(CHECK, format!("{found}: Pinion stays below that")),
    }
}

fn isolation(computer: &Computer, instances: &[Instance]) -> Vec<Finding> {
    const CHECK: &str = "isolated_cpus";
    let Some(isolated) = computer.text("/sys/devices/system/cpu/isolated") else {
        return vec![Finding::ok(
            CHECK,
            "which processors are isolated is unknown: there is no /sys/devices/system/cpu/isolated",
        )];
    };
    // If it is unknown, any processor may be there.
    let present = computer.text("/sys/devices/system/cpu/present").filter(|present| !present.is_empty());
    let mut findings = Vec::new();
    let mut taken: Vec<usize> = Vec::new();
    for instance in instances {
        let Some(cpu) = instance.settings.cpu else { continue };
        let (name, config) = (instance.name(), instance.config());
        findings.push(match isolated.as_str() {
            _ if present.as_ref().is_some_and(|present| !is_among(present, cpu)) => {
                let present = present.as_deref().unwrap_or_default();
                Finding::error(
                    CHECK,
                    format!("{name} is configured for processor {cpu}, but this computer has {present}"),
                    format!("cpu = {} in {config}", last(present)),
                )
            }
            _ if taken.contains(&cpu) => Finding::warning(
                CHECK,
                format!("{name} stays on processor {cpu}, like another Pinion: each delays the other"),
                format!("another cpu in {config}"),
            ),
            "" => Finding::warning(
                CHECK,
                format!("{name} stays on processor {cpu}, which is not isolated: other programs use it, too"),
                format!("append isolcpus={cpu} to the kernel's command line, and reboot"),
            ),
            isolated if is_among(isolated, cpu) => {
                Finding::ok(CHECK, format!("{name} stays on processor {cpu}; isolated: {isolated}"))
            }
            isolated => Finding::warning(
                CHECK,
                format!("{name} stays on processor {cpu}, but other processors are isolated: {isolated}"),
                format!("cpu = {} in {config}", first(isolated)),
            ),
        });
        taken.push(cpu);
    }
    if findings.is_empty() {
        findings.push(match isolated.as_str() {
            "" => Finding::ok(CHECK, "no processor is isolated, and Pinion runs on any"),
            isolated => Finding::warning(
                CHECK,
                format!("isolated: {isolated}, but unused: Pinion is not configured to use them"),
                format!("cpu = {} in /etc/pinion/pinion.toml", first(isolated)),
            ),
        });
    }
    findings
}

/// Whether a list such as `1,3-5` has this number.
fn is_among(list: &str, number: usize) -> bool {
    list.split(',').any(|range| {
        let (first, last) = range.split_once('-').unwrap_or((range, range));
        matches!((first.parse(), last.parse()), (Ok(first), Ok(last)) if (first..=last).contains(&number))
    })
}

fn last(list: &str) -> &str {
    list.rsplit([',', '-']).next().unwrap_or(list)
}

fn first(range: &str) -> &str {
    range.split([',', '-']).next().unwrap_or(range)
}

/// `None` if processors have only one frequency, as in a virtual computer.
fn governor(computer: &Computer) -> Option<Finding> {
    const CHECK: &str = "governor";
    let files = computer.matching("/sys/devices/system/cpu/cpu*/cpufreq/scaling_governor");
    let mut governors: Vec<String> = files.iter().filter_map(|file| computer.text(computer.name(file))).collect();
    governors.sort();
    governors.dedup();
    let slow: Vec<&str> = governors.iter().map(String::as_str).filter(|name| *name != "performance").collect();
    match (governors.is_empty(), slow.is_empty()) {
        (true, _) => None,
        (_, true) => Some(Finding::ok(CHECK, "the processors' frequency governor is performance")),
        _ => Some(Finding::warning(
            CHECK,
            format!("the processors' frequency governor is {}: changes of the frequency take time", slow.join(", ")),
            "echo performance | sudo tee /sys/devices/system/cpu/cpu*/cpufreq/scaling_governor",
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::says;
    use super::*;
    use crate::tree::Tree;
    use pinion_system::finding::Level::{Error, Ok, Warning};
    use pinion_system::instance::instances;

    fn found(tree: &Tree, cpu: Option<usize>) -> Vec<Finding> {
        tree.put("etc/pinion/pinion.toml", cpu.map_or(String::new(), |cpu| format!("cpu = {cpu}\n")));
        findings(&tree.computer(), &instances(&tree.computer()).0)
    }

    #[test]
    fn a_kernel_that_is_set_up_for_real_time() {
        let tree = Tree::empty();
        tree.put("proc/version", "Linux version 6.12.0-rt-amd64 #1 SMP PREEMPT_RT Debian\n");
        tree.put("proc/sys/kernel/osrelease", "6.12.0-rt-amd64\n");
        tree.put("proc/sys/kernel/sched_rt_runtime_us", "950000\n");
        tree.put("proc/sys/kernel/sched_rt_period_us", "1000000\n");
        tree.put("sys/devices/system/cpu/isolated", "1,3-5\n");
        tree.put("sys/devices/system/cpu/cpu0/cpufreq/scaling_governor", "performance\n");
        let findings = found(&tree, Some(4));
        assert!(findings.len() == 5 && findings.iter().all(|finding| finding.status == Ok), "{findings:?}");
        tree.put("proc/version", "Linux version 5.15.0 #1 SMP PREEMPT RT\n");
        says(&found(&tree, Some(4)), "preempt_rt", Ok, "is PREEMPT_RT");
        tree.put("proc/version", "Linux\n");
        tree.put("sys/kernel/realtime", "1\n");
        says(&found(&tree, Some(4)), "preempt_rt", Ok, "is PREEMPT_RT");
        tree.put("proc/sys/kernel/sched_rt_runtime_us", "-1\n");
        says(&found(&tree, Some(4)), "rt_throttling", Ok, "does not throttle");
    }

    #[test]
    fn a_kernel_that_is_not() {
        let tree = Tree::empty();
        tree.put("proc/version", "Linux version 6.1.0 #1 SMP PREEMPT_DYNAMIC\n");
        tree.put("proc/sys/kernel/osrelease", "6.1.0-rpi4-rpi-v8\n");
        tree.put("proc/sys/kernel/sched_rt_runtime_us", "0\n");
        tree.put("proc/sys/kernel/sched_rt_period_us", "1000000\n");
        tree.put("sys/devices/system/cpu/isolated", "3\n");
        tree.put("sys/devices/system/cpu/cpu0/cpufreq/scaling_governor", "ondemand\n");
        tree.put("sys/devices/system/cpu/cpu1/cpufreq/scaling_governor", "performance\n");
        let findings = found(&tree, None);
        let rt = says(&findings, "preempt_rt", Warning, "6.1.0-rpi4-rpi-v8 is not PREEMPT_RT");
        assert!(rt.starts_with("sudo apt install linux-image-rpi-v8-rt"), "{rt}");
        // There is no such package for 32 bits.
        tree.put("proc/sys/kernel/osrelease", "6.12.25+rpt-rpi-v7\n");
        let rt = says(&found(&tree, None), "preempt_rt", Warning, "6.12.25+rpt-rpi-v7 is not PREEMPT_RT");
        assert!(rt.starts_with("install a 64-bit Raspberry Pi OS"), "{rt}");
        says(&findings, "rt_throttling", Error, "no real time");
        assert_eq!(says(&findings, "isolated_cpus", Warning, "but unused"), "cpu = 3 in /etc/pinion/pinion.toml");
        says(&findings, "governor", Warning, "is ondemand:");
        tree.put("proc/sys/kernel/sched_rt_runtime_us", "100000\n");
        says(&found(&tree, Some(2)), "rt_throttling", Warning, "100000 of 1000000");
        says(&found(&tree, Some(2)), "isolated_cpus", Warning, "but other processors are isolated: 3");
        tree.put("sys/devices/system/cpu/isolated", "\n");
        assert!(says(&found(&tree, Some(2)), "isolated_cpus", Warning, "not isolated").contains("isolcpus=2"));
        tree.put("sys/devices/system/cpu/present", "0-3\n");
        assert!(says(&found(&tree, Some(2)), "isolated_cpus", Warning, "not isolated").contains("isolcpus=2"));
        // A processor that is not there cannot be isolated either.
        for isolated in ["", "99", "2-3"] {
            tree.put("sys/devices/system/cpu/isolated", isolated);
            let remedy = says(&found(&tree, Some(99)), "isolated_cpus", Error, "processor 99, but this computer has");
            assert_eq!(remedy, "cpu = 3 in /etc/pinion/pinion.toml");
        }
    }

    #[test]
    fn instances_on_processors_of_their_own_or_on_one() {
        let tree = Tree::empty();
        tree.put("sys/devices/system/cpu/isolated", "2-3\n");
        for (pid, cpu) in [(10, "2"), (11, "3")] {
            tree.process(
                pid,
                &["/usr/bin/pinion", "run", "--cpu", cpu, "-I", &format!("/tmp/klipper_host_{pid}")],
                0,
                &[],
            );
        }
        let findings = found(&tree, None);
        says(&findings, "isolated_cpus", Ok, "process 10 stays on processor 2");
        says(&findings, "isolated_cpus", Ok, "process 11 stays on processor 3");
        tree.process(11, &["/usr/bin/pinion", "run", "--cpu", "2", "-I", "/tmp/klipper_host_11"], 0, &[]);
        says(&found(&tree, None), "isolated_cpus", Warning, "process 11 stays on processor 2, like another Pinion");
    }

    #[test]
    fn kernels_that_are_too_old_for_some_or_for_all() {
        let tree = Tree::empty();
        for (release, status, words) in [
            ("4.9.337-h616", Error, "needs 4.13 or later"),
            ("4.13.0", Warning, "pull-up"),
            ("5.4.83-v7l+", Warning, "pull-up"),
            ("5.5.0", Warning, "tachometers are polled"),
            ("5.10.0", Ok, "has all"),
            ("6.12.25+rpt-rpi-v8", Ok, "has all"),
        ] {
            tree.put("proc/sys/kernel/osrelease", release);
            says(&found(&tree, None), "kernel_version", status, words);
        }
    }

    #[test]
    fn facts_that_the_kernel_does_not_give_are_unknown() {
        let findings = found(&Tree::empty(), None);
        assert_eq!(findings.len(), 4);
        for finding in findings {
            let found = finding.trouble.found();
            assert!(finding.status == Ok && (found.contains("unknown") || found.contains("does not say")), "{found}");
        }
    }
}
