// SPDX-License-Identifier: GPL-3.0-or-later
//! One clock for a klippy and the simulated printer.
//!
//! Both take turns. The printer runs its MCUs in virtual time until klippy waits for something: until a time comes, or
//! until an MCU has sent something. Then klippy has the turn until it waits again. Computing takes no time on either side,
//! so nothing is ever late, on any computer. klippy takes part by a library (simulator/clock), which has the messages of the
//! turns.

use std::fmt::{self, Display};
use std::io::{self, Read, Write};
use std::os::fd::AsRawFd;
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use nix::fcntl::{FcntlArg, FdFlag, fcntl};
use pinion_firmware::feature::FEATURES;
use pinion_firmware::mcu::{DialectName, Forms};
use pinion_firmware::time::{Clock, NS_PER_TICK, TimeSource as _, VirtualClock};
use pinion_firmware::trouble::Trouble;
use pinion_model::SimBoard;
use pinion_runtime::klippy::Checkout;

use crate::hang::Hang;
use crate::mcu::BoardMcu;

/// The library in klippy.
pub(crate) const LIBRARY: &str = "libpinion_clock.so";
/// The environment's word for it.
pub(crate) const WORD: &str = "PINION_CLOCK";
/// Beginning of the paths that the library takes for the simulated MCUs'.
pub const MCUS: &str = "/tmp/klipper_host_clock_";
/// The printer's time at the start. klippy takes a time near zero for none at all.
const START: Duration = Duration::from_secs(1000);
/// The first word of the library.
const HELLO: &[u8; 8] = b"pinion1\0";
/// How long, in real time, klippy's Python may take to load the library.
const LOAD: Duration = Duration::from_secs(20);
/// How long, in real time, klippy may compute until it waits for something.
const COMPUTE: Duration = Duration::from_secs(120);
/// How often klippy's process may run another program in its own place.
const HELLOS_MAX: u32 = 8;
/// How far klippy's readings of the clock may move it in a turn.
const READINGS_NS_MAX: u64 = 10_000_000_000;
/// Turns without so much of the printer's time are no progress.
const PROGRESS_NS: u64 = 1_000_000;
/// Real time between two looks whether the program shall end.
const LOOK: Duration = Duration::from_millis(100);

/// Why klippy takes no more turns.
#[derive(Debug)]
pub enum Stop {
    /// It has ended.
    Ended,
    /// It computes without an end, or waits for something outside of the clock.
    Hangs(Option<Hang>),
    /// The program is asked to end.
    Asked,
}

impl Display for Stop {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Stop::Ended => f.write_str("it has ended"),
            Stop::Hangs(hang) => {
                write!(f, "the printer has waited for it for {} s of the computer", COMPUTE.as_secs())?;
                hang.iter().try_for_each(|hang| write!(f, ": {hang}"))
            }
            Stop::Asked => f.write_str("the trial was ended"),
        }
    }
}

/// klippy's end of the turns.
struct Player {
    socket: UnixStream,
    /// Until when it waits.
    until_ns: u64,
}

/// A klippy and a printer in one clock.
pub struct OneClock {
    clock: VirtualClock,
    now_ns: u64,
    mcus: Vec<BoardMcu>,
    player: Option<Player>,
    /// klippy may have something to read.
    has_news: bool,
    /// klippy takes no more turns.
    has_stopped: bool,
    pace: Option<Pace>,
    /// Set when the program is asked to end.
    ended: Arc<AtomicBool>,
}

/// The highest pace of the printer's time.
struct Pace {
    /// Seconds of the printer in a second of the computer.
    speed: f64,
    /// A time of the computer, and the printer's time then.
    from: (Instant, u64),
}

/// Time between two turns of klippy at a pace: somebody outside of the clock may have sent it something.
const OUTSIDE: Duration = Duration::from_millis(4);
/// How far the printer's time may be behind its pace and still catch up. What a busy computer loses beyond is lost.
const BEHIND: Duration = Duration::from_millis(50);

impl Pace {
    /// The time that the printer may have by now.
    fn until_ns(&mut self, now_ns: u64) -> u64 {
        let (since, from_ns) = self.from;
        let until_ns = from_ns + (since.elapsed().as_nanos() as f64 * self.speed) as u64;
        let latest_ns = now_ns + (BEHIND.as_nanos() as f64 * self.speed) as u64;
        if until_ns > latest_ns {
            self.from = (Instant::now(), latest_ns);
        }
        until_ns.min(latest_ns)
    }
}

/// The forms that the sources of a klippy look up, or those of all hosts if they cannot be read.
pub fn forms(klipper: &Path) -> Forms {
    let checkout = Checkout::read(&klipper.join("klippy"), FEATURES);
    checkout.map_or(DialectName::Union.into(), |checkout| Forms::Host(checkout.forms))
}

/// The clock of a printer before it runs.
pub fn start() -> VirtualClock {
    VirtualClock::at(Clock::from_ticks(START.as_nanos() as u64 / NS_PER_TICK))
}

impl OneClock {
    /// The boards of a printer whose time is `clock`. klippy finds them by `links`, which lead to sockets in `folder`.
    ///
    /// # Errors
    ///
    /// A socket cannot be made.
    pub fn new(
        clock: VirtualClock,
        boards: Vec<SimBoard>,
        (links, folder): (&[PathBuf], &Path),
        forms: &Forms,
        ended: Arc<AtomicBool>,
    ) -> Result<OneClock, Trouble> {
        let socket = |link: &PathBuf| folder.join(link.to_string_lossy().trim_start_matches(MCUS));
        let mcus = boards.into_iter().zip(links).map(|(board, link)| {
            let path = socket(link);
            // An earlier trial has left it.
            let _ = std::fs::remove_file(&path);
            BoardMcu::new(board, forms.clone(), &path)
        });
        let mcus = mcus.collect::<Result<_, _>>()?;
        Ok(OneClock {
            clock,
            now_ns: START.as_nanos() as u64,
            mcus,
            player: None,
            has_news: true,
            has_stopped: false,
            pace: None,
            ended,
        })
    }

    /// Keeps the printer's time to this many seconds in a second, if the computer is fast enough.
    pub fn keep_pace(&mut self, speed: f64) {
        self.pace = Some(Pace { speed, from: (Instant::now(), self.now_ns) });
    }

    pub(crate) fn now(&self) -> Duration {
        Duration::from_nanos(self.now_ns)
    }

    /// A socket for another klippy, which inherits the second end.
    ///
    /// # Errors
    ///
    /// There are too many descriptors.
    pub(crate) fn invite(&mut self) -> io::Result<(UnixStream, UnixStream)> {
        (self.player, self.has_stopped) = (None, false);
        self.mcus.iter_mut().for_each(BoardMcu::renew);
        let (ours, theirs) = UnixStream::pair()?;
        ours.set_read_timeout(Some(LOOK))?;
        ours.set_write_timeout(Some(LOOK))?;
        fcntl(&theirs, FcntlArg::F_SETFD(FdFlag::empty()))?;
        Ok((ours, theirs))
    }

    /// Waits until klippy takes part.
    ///
    /// # Errors
    ///
    /// It does not, because its program does not load the library, or has ended.
    pub(crate) fn await_player(&mut self, socket: UnixStream) -> Result<(), Stop> {
        let mut hello = [0; 16];
        self.receive(&socket, &mut hello, Instant::now() + LOAD)?;
        if hello[..8] != *HELLO {
            return Err(Stop::Ended);
        }
        self.player = Some(Player { socket, until_ns: 0 });
        self.has_news = true;
        Ok(())
    }

    /// klippy may have something to read: the caller has sent it something.
    pub(crate) fn poke(&mut self) {
        self.has_news = true;
    }

    /// Lets time pass until `until`, or until `is_over` says so behind a turn of klippy. Returns whether it did.
    ///
    /// # Errors
    ///
    /// klippy takes no more turns.
    pub(crate) fn run(&mut self, until: Duration, is_over: &mut dyn FnMut() -> bool) -> Result<bool, Stop> {
        let until_ns = until.as_nanos() as u64;
        if self.has_stopped {
            return Err(Stop::Ended);
        }
        let mut progress = (Instant::now(), self.now_ns);
        let mut turns = 0_u32;
        loop {
            if self.ended.load(Ordering::Relaxed) {
                return Err(Stop::Asked);
            }
            let player_ns = self.player.as_ref().map_or(u64::MAX, |player| player.until_ns);
            if self.player.is_some() && (self.has_news || self.now_ns >= player_ns) {
                self.pass_turn()?;
                turns = turns.wrapping_add(1);
                if self.now_ns > progress.1 + PROGRESS_NS {
                    progress = (Instant::now(), self.now_ns);
                } else if turns.is_multiple_of(1024) && progress.0.elapsed() > COMPUTE {
                    self.has_stopped = true;
                    return Err(Stop::Hangs(None));
                }
                for mcu in &mut self.mcus {
                    mcu.take_in();
                    self.has_news |= mcu.turn();
                }
                self.now_ns = self.now_ns.max(ns_of(&self.clock));
                if is_over() {
                    return Ok(true);
                }
                continue;
            }
            if self.now_ns >= until_ns {
                return Ok(false);
            }
            let mut limit_ns = until_ns.min(player_ns);
            if let Some(pace) = &mut self.pace {
                let paced_ns = pace.until_ns(self.now_ns);
                if paced_ns <= self.now_ns {
                    std::thread::sleep(OUTSIDE);
                    self.has_news = true;
                    continue;
                }
                limit_ns = limit_ns.min(paced_ns);
            }
            self.has_news = self.run_mcus(limit_ns);
        }
    }

    /// Runs the MCUs until a time, or until one of them sends something. Returns whether one did.
    fn run_mcus(&mut self, until_ns: u64) -> bool {
        loop {
            let next = self.mcus.iter_mut().map(|mcu| (mcu.next_ns(), mcu)).min_by_key(|(next_ns, _)| *next_ns);
            let Some((next_ns, mcu)) = next.filter(|(next_ns, _)| *next_ns <= until_ns) else {
                self.now_ns = self.now_ns.max(until_ns);
                set(&self.clock, self.now_ns);
                return false;
            };
            // A board's clock that drifts may be a tick behind.
            let at_ns = if next_ns <= self.now_ns { self.now_ns + NS_PER_TICK } else { next_ns };
            set(&self.clock, at_ns);
            let has_sent = mcu.turn();
            // A pulse of the MCU itself takes time.
            self.now_ns = ns_of(&self.clock);
            if has_sent {
                return true;
            }
        }
    }

    /// Gives klippy the turn, and waits until it comes back. A klippy that stops takes no more turns.
    fn pass_turn(&mut self) -> Result<(), Stop> {
        let passed = self.try_pass_turn();
        self.has_stopped = passed.is_err();
        passed
    }

    fn try_pass_turn(&mut self) -> Result<(), Stop> {
        let Some(player) = &self.player else { return Err(Stop::Ended) };
        let mut turn = [0; 16];
        turn[..8].copy_from_slice(&self.now_ns.to_le_bytes());
        turn[8..].copy_from_slice(&u64::from(self.has_news).to_le_bytes());
        self.has_news = false;
        let given = turn;
        for hellos in 0.. {
            if hellos > HELLOS_MAX {
                return Err(Stop::Ended);
            }
            (&player.socket).write_all(&given).map_err(|_| Stop::Ended)?;
            self.receive(&player.socket, &mut turn, Instant::now() + COMPUTE)?;
            // A script has started klippy's Python in its own place.
            if turn[..8] != *HELLO {
                break;
            }
        }
        let word = |at: usize| u64::from_le_bytes(turn[at..at + 8].try_into().unwrap_or_default());
        // Each reading of the clock takes it some nanoseconds. A printer.cfg is a program, which may say anything.
        let now_ns = word(0).clamp(self.now_ns, self.now_ns + READINGS_NS_MAX);
        while self.now_ns < now_ns {
            self.has_news |= self.run_mcus(now_ns);
        }
        if let Some(player) = &mut self.player {
            player.until_ns = word(8);
        }
        Ok(())
    }

    fn receive(&self, mut socket: &UnixStream, bytes: &mut [u8; 16], until: Instant) -> Result<(), Stop> {
        let mut filled = 0;
        while filled < bytes.len() {
            match socket.read(&mut bytes[filled..]) {
                Ok(0) => return Err(Stop::Ended),
                Ok(read) => filled += read,
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {
                    if self.ended.load(Ordering::SeqCst) {
                        return Err(Stop::Asked);
                    }
                    if Instant::now() > until {
                        return Err(Stop::Hangs(None));
                    }
                }
                Err(_) => return Err(Stop::Ended),
            }
        }
        Ok(())
    }
}

fn ns_of(clock: &VirtualClock) -> u64 {
    clock.now().ticks() * NS_PER_TICK
}

fn set(clock: &VirtualClock, ns: u64) {
    clock.set(Clock::from_ticks(ns.div_ceil(NS_PER_TICK)));
}

/// The word for the library of a klippy that inherits `socket`.
pub(crate) fn word(socket: &UnixStream, folder: &Path) -> String {
    format!("{}:0:{}", socket.as_raw_fd(), folder.display())
}

#[cfg(test)]
mod tests {
    use super::*;
    use pinion_model::{SimConfig, SimWorld};
    use pinion_protocol::block::{Sequence, frame};
    use pinion_protocol::vlq::Writer;
    use std::thread;

    /// A klippy that asks an MCU for its dictionary's first bytes, and notes the times of its turns.
    fn ask(turns: UnixStream, mcu: &Path) -> Vec<(u64, u64, usize)> {
        let mut turns = turns;
        let send = |turns: &mut UnixStream, words: [u64; 2]| {
            turns.write_all(&[words[0].to_le_bytes(), words[1].to_le_bytes()].concat()).unwrap();
        };
        let hear = |turns: &mut UnixStream| {
            let mut bytes = [0; 16];
            turns.read_exact(&mut bytes).unwrap();
            [0, 8].map(|at| u64::from_le_bytes(bytes[at..at + 8].try_into().unwrap()))
        };
        send(&mut turns, [u64::from_le_bytes(*HELLO), 0]);
        let [start_ns, _] = hear(&mut turns);
        let mut wire = UnixStream::connect(mcu).unwrap();
        wire.set_nonblocking(true).unwrap();
        let mut seen = Vec::new();
        let mut now_ns = start_ns;
        let mut heard = [0; 4096];
        for (is_asked, wait_ns) in [(true, 4_000_000_000), (false, 4_000_000_000), (false, 1_000_000)] {
            if is_asked {
                let mut command = Writer::default();
                [1, 0, 40].into_iter().for_each(|number| command.int(number));
                let mut block = Vec::new();
                frame(command.payload().unwrap(), Sequence::default(), &mut block);
                wire.write_all(&block).unwrap();
            }
            // A little computing. The MCU sends `stats` each five seconds.
            now_ns += 40;
            send(&mut turns, [now_ns, now_ns + wait_ns]);
            let [then_ns, news] = hear(&mut turns);
            seen.push((then_ns - now_ns, news, wire.read(&mut heard).unwrap_or(0)));
            now_ns = then_ns;
        }
        seen
    }

    #[test]
    fn an_answer_takes_the_link_s_time_and_a_wait_takes_all_of_it() {
        let folder = tempfile::tempdir().unwrap();
        let clock = start();
        let config = SimConfig::parse(SimConfig::default_toml(), "the default").unwrap();
        let SimWorld { boards, .. } = SimWorld::new(config, Arc::new(clock.clone())).unwrap();
        let links = [PathBuf::from(format!("{MCUS}mcu"))];
        let forms = Forms::from(DialectName::Master);
        let mut one = OneClock::new(clock, boards, (&links, folder.path()), &forms, Arc::default()).unwrap();
        let (ours, theirs) = one.invite().unwrap();
        let mcu = folder.path().join("mcu");
        let player = thread::spawn(move || ask(theirs, &mcu));
        one.await_player(ours).unwrap();
        let began = one.now();
        assert!(!one.run(began + Duration::from_secs(2), &mut || false).unwrap());
        assert_eq!(one.now(), began + Duration::from_secs(2), "time passes while klippy waits");
        assert!(matches!(one.run(began + Duration::from_secs(100), &mut || false), Err(Stop::Ended)));
        let seen = player.join().unwrap();
        let [(answered_ns, 1, answer), waited, last] = seen[..] else { panic!("{seen:?}") };
        assert!((500_000..501_000).contains(&answered_ns) && answer > 40, "{seen:?}");
        assert_eq!((waited, last), ((4_000_000_000, 0, 0), (1_000_000, 0, 0)));
        assert!(matches!(one.run(began + Duration::from_secs(200), &mut || false), Err(Stop::Ended)));
    }

    #[test]
    fn a_pace_is_kept_and_what_is_lost_is_not_caught_up() {
        let ago = |s: u64| Instant::now().checked_sub(Duration::from_secs(s)).unwrap();
        let mut pace = Pace { speed: 2.0, from: (ago(10), 1_000_000_000) };
        // 20 s are over, and the printer is there.
        let until_ns = pace.until_ns(21_000_000_000);
        assert!((21_000_000_000..=21_100_000_000).contains(&until_ns), "{until_ns}");
        // It is 19 s behind: it may catch up a tenth of a second.
        let mut pace = Pace { speed: 2.0, from: (ago(10), 1_000_000_000) };
        assert_eq!(pace.until_ns(2_000_000_000), 2_100_000_000);
        assert!(pace.until_ns(2_100_000_000) <= 2_200_000_000);
    }
}
