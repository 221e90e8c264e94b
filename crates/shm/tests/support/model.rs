// SPDX-License-Identifier: GPL-3.0-or-later
//! Models for loom. Each one runs two threads in all orders, with all values that the orderings allow a load to return.
//! Each one asserts what the users of a structure rely on (docs/develop/sanitizers.md).

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed as Std};

use crate::atomic::{AtomicU32, AtomicU64, Ordering};
use crate::heartbeat::{SharedHeartbeat, WorkerSlot};
use crate::progress::Progress;
use crate::ring::{self, Lookup, Ring};
use crate::seqlock::Seqlock;
use crate::sleep_flag::SleepFlag;
use crate::watch::Watch;

/// Runs a model, and prints in how many orders. `one` and `other` share what `start` makes, and `check` sees what both
/// return.
///
/// Loom tries other orders only for the latest access to a word. If a thread loads a word and then stores to it, loom
/// forgets that another thread may have loaded the word before. So each side is the first one once.
fn model<S: Send + Sync + 'static, A: Send + 'static, B: Send + 'static>(
    name: &str,
    start: impl Fn() -> S + Copy + Send + Sync + 'static,
    one: impl Fn(&S) -> A + Copy + Send + Sync + 'static,
    other: impl Fn(&S) -> B + Copy + Send + Sync + 'static,
    check: impl Fn(&S, A, B) + Copy + Send + Sync + 'static,
) {
    let orders = Arc::new(AtomicUsize::new(0));
    for is_swapped in [false, true] {
        let orders = orders.clone();
        loom::model(move || {
            orders.fetch_add(1, Std);
            let shared = Arc::new(start());
            let theirs = shared.clone();
            if is_swapped {
                let one = loom::thread::spawn(move || one(&theirs));
                let other = other(&shared);
                check(&shared, one.join().unwrap(), other);
            } else {
                let other = loom::thread::spawn(move || other(&theirs));
                let one = one(&shared);
                check(&shared, one, other.join().unwrap());
            }
        });
    }
    println!("{name}: {} orders", orders.load(Std));
}

fn words<const N: usize>() -> [AtomicU32; N] {
    std::array::from_fn(|_| AtomicU32::new(0))
}

/// The words of a ring with the records 0 to `records` less one.
fn ring(capacity: usize, records: u64) -> Box<[AtomicU64]> {
    let words: Box<[AtomicU64]> = (0..ring::words(capacity)).map(|_| AtomicU64::new(0)).collect();
    (0..records).for_each(|number| Ring::new(&words).push([number; 2]));
    words
}

#[test]
fn a_reader_beside_a_writer_sees_whole_records_in_order_and_misses_only_overwritten_ones() {
    for (capacity, pushes) in [(2, 2), (4, 1)] {
        model(
            "ring: newest",
            move || ring(capacity as usize, capacity),
            move |words| (0..pushes).for_each(|number| Ring::new(words).push([capacity + number; 2])),
            |words| Ring::new(words).newest(),
            move |_, (), newest| {
                assert!(newest.iter().all(|[one, other]| one == other), "torn: {newest:?}");
                assert!(newest.windows(2).all(|two| two[0][0] + 1 == two[1][0]), "out of order: {newest:?}");
                for number in (pushes + 1)..capacity {
                    assert!(newest.contains(&[number; 2]), "{number} is missing: {newest:?}");
                }
            },
        );
    }
}

#[test]
fn a_record_is_itself_or_overwritten() {
    model(
        "ring: get",
        || ring(2, 1),
        |words| (1..4).for_each(|number| Ring::new(words).push([number; 2])),
        |words| {
            let ring = Ring::new(words);
            (ring.next(), ring.get(1), ring.next())
        },
        |_, (), (before, found, after)| match found {
            Lookup::Record(record) => assert_eq!(record, [1; 2]),
            Lookup::NotYet => assert!(before < 2),
            Lookup::Overwritten => assert!(after > 2),
        },
    );
}

#[test]
fn a_writer_goes_on_after_the_last_one() {
    let write = |words: &[AtomicU64], name: &str| {
        let ring = Ring::new(words);
        let pen = ring.pen(name).map(|mut pen| {
            pen.push([7; 2]);
            assert_eq!(ring.name(), name);
        });
        pen.map_or(0, |()| 1)
    };
    model(
        "ring: two writers in turn",
        || ring(4, 0),
        move |words| write(words, "one"),
        move |words| write(words, "two"),
        |words, one, two| {
            assert!(one + two > 0, "each found the other");
            assert_eq!(Ring::new(words).newest().len(), one + two, "one has overwritten the other");
        },
    );
}

#[test]
fn a_first_name_is_whole() {
    const NAME: &str = "iio:device12";
    model(
        "ring: name",
        || ring(1, 0),
        |words| drop(Ring::new(words).pen(NAME).unwrap()),
        |words| Ring::new(words).name(),
        |_, (), name| assert!(name.is_empty() || name == NAME, "{name}"),
    );
}

#[test]
fn words_are_together() {
    model(
        "together",
        || Seqlock::of(&[0; 2]),
        |words| (1..=2).for_each(|word| words.store([word; 2])),
        |words| words.load(|words| words.collect::<Vec<_>>()),
        |_, (), words| assert_eq!(words[0], words[1], "torn"),
    );
}

/// Words are not older than a message about them.
#[test]
fn words_are_as_new_as_the_message_about_them() {
    model(
        "together: a message",
        || (Seqlock::of(&[0; 2]), words::<1>()),
        |(words, flag)| {
            words.store([1; 2]);
            flag[0].store(1, Ordering::Release);
        },
        |(words, flag)| (flag[0].load(Ordering::Acquire), words.load(|words| words.collect::<Vec<_>>())),
        |_, (), (flag, words)| assert!(flag == 0 || words == [1; 2], "{words:?}"),
    );
}

const IDLE: u32 = 30_000;
const RUNNING: u32 = 550;

#[test]
fn a_beat_is_as_new_as_its_limit() {
    let start = || {
        let words = words::<4>();
        SharedHeartbeat::new(&words).beat(1, IDLE);
        words
    };
    model(
        "heart: beats",
        start,
        |words| (2..=3).for_each(|at| SharedHeartbeat::new(words).beat(at, RUNNING)),
        |words| SharedHeartbeat::new(words).listen(),
        |_, (), heard| assert!(heard.silence_max_ms == Some(IDLE) || heard.beat_at >= 2, "{heard:?}"),
    );
}

#[test]
fn a_pending_value_has_its_subject_and_begins_and_ends_with_a_beat() {
    let start = || {
        let words = words::<5>();
        SharedHeartbeat::new(&words).beat(1, RUNNING);
        words
    };
    model(
        "heart: a value is pending",
        start,
        |words| {
            SharedHeartbeat::new(words).set_pending("pwmchip0", 5);
            // The core goes on, and this does not count.
            SharedHeartbeat::new(words).beat(6, RUNNING);
        },
        |words| (SharedHeartbeat::new(words).listen(), SharedHeartbeat::new(words).subject().get()),
        |_, (), (heard, subject)| {
            assert!(
                heard.silence_max_ms.is_some() || (heard.beat_at == 5 && subject == "pwmchip0"),
                "{heard:?} {subject}"
            );
        },
    );
    model(
        "heart: no value is pending",
        move || {
            let words = start();
            SharedHeartbeat::new(&words).set_pending("pwmchip0", 5);
            words
        },
        |words| SharedHeartbeat::new(words).clear_pending(9),
        |words| SharedHeartbeat::new(words).listen(),
        |_, (), heard| assert!(heard.silence_max_ms.is_none() || heard.beat_at == 9, "{heard:?}"),
    );
}

#[test]
fn a_worker_is_not_blamed_for_the_job_of_the_one_before() {
    let start = || {
        let words = words::<3>();
        WorkerSlot::new(&words).name().set("old");
        WorkerSlot::new(&words).begin(1);
        words
    };
    // A third thread, the old worker, frees the slot.
    let replace = |words: &[AtomicU32; 3]| {
        if !WorkerSlot::new(words).name().is_set() {
            WorkerSlot::new(words).name().set("new one");
        }
    };
    let check = |name: String, busy: Option<u32>| {
        assert!(!name.starts_with("new ") || (name == "new one" && busy.is_none()), "{name} {busy:?}");
    };
    model(
        "slot: a worker ends, another begins",
        start,
        |words| WorkerSlot::new(words).free(),
        replace,
        move |words, (), ()| check(WorkerSlot::new(words).name().get(), WorkerSlot::new(words).busy_since()),
    );
    model(
        "slot: a reader",
        start,
        move |words| {
            WorkerSlot::new(words).free();
            replace(words);
        },
        |words| (WorkerSlot::new(words).name().get(), WorkerSlot::new(words).busy_since()),
        move |_, (), (name, busy)| check(name, busy),
    );
}

/// The link sleeps and wakes up, while the core puts something where it looks.
#[test]
fn no_wake_up_is_lost() {
    let put = |(sleep_flag, put, event): &(SleepFlag, [AtomicU32; 1], [AtomicU32; 1])| {
        for number in 1..=2 {
            put[0].store(number, Ordering::Release);
            if sleep_flag.is_to_be_woken() {
                event[0].fetch_add(1, Ordering::AcqRel);
            }
        }
    };
    model(
        "sleep_flag",
        || (SleepFlag::default(), words::<1>(), words::<1>()),
        put,
        |(sleep_flag, put, event)| {
            // It goes to sleep, as it has nothing to do. It wakes up for a call, or because it wants to.
            sleep_flag.begin();
            put[0].load(Ordering::Acquire);
            let is_called = event[0].load(Ordering::Acquire) != 0;
            sleep_flag.end();
            if is_called {
                event[0].swap(0, Ordering::AcqRel);
            }
            // This time it wakes up only for a call.
            sleep_flag.begin();
            put[0].load(Ordering::Acquire) == 2
        },
        |(_, _, event), (), has_seen_all| {
            assert!(has_seen_all || event[0].load(Ordering::Acquire) != 0, "it sleeps, and something is there");
        },
    );
}

#[test]
fn a_block_that_a_freed_core_does_not_see_wakes_it() {
    let start = || {
        let progress = Progress::default();
        progress.hold(true);
        (progress, words::<1>())
    };
    model(
        "hold",
        start,
        |(progress, blocks)| {
            progress.hold(false);
            blocks[0].load(Ordering::Acquire) == 1
        },
        |(progress, blocks)| {
            blocks[0].store(1, Ordering::Release);
            !progress.is_held()
        },
        |_, sees_it, is_woken| assert!(sees_it || is_woken, "the core sleeps, and a block is there"),
    );
}

#[test]
fn a_finished_block_has_its_responses() {
    model(
        "done",
        || (Progress::default(), words::<1>()),
        |(progress, responses)| {
            for _ in 0..2 {
                responses[0].store(progress.begin(), Ordering::Release);
                progress.finish();
            }
        },
        |(progress, responses)| (progress.done(), responses[0].load(Ordering::Acquire)),
        |_, (), (done, responses)| assert!(responses >= done, "an acknowledgement is ahead of its response"),
    );
}

#[test]
fn no_response_comes_before_a_published_answer_that_it_outdates() {
    let start = || {
        let progress = Progress::default();
        progress.publish(1);
        (progress, words::<1>())
    };
    model(
        "publish",
        start,
        |(progress, responses)| {
            progress.withdraw();
            responses[0].store(1, Ordering::Release);
        },
        |(progress, responses)| (responses[0].load(Ordering::Acquire), progress.published()),
        |_, (), seen| assert_ne!(seen, (1, 1), "the answer is older than the response before it"),
    );
}

#[test]
fn a_stop_request_in_the_ring_is_counted() {
    model(
        "stops",
        || (Progress::default(), words::<1>()),
        |(progress, requests)| {
            for request in 1..=2 {
                progress.stop_handed();
                requests[0].store(request, Ordering::Release);
            }
        },
        |(progress, requests)| (requests[0].load(Ordering::Acquire), progress.stops_handed()),
        |_, (), (taken, handed)| assert!(handed >= taken, "the core has taken more than it was handed"),
    );
}

/// The line is a word: the number of the pulse while it is high, 0 while it is low. The first thread makes a pulse that
/// nobody watches only if the second one has not come, or watches no pulse any more.
#[test]
fn no_store_for_a_pulse_comes_after_it_and_the_first_thread_knows_of_it() {
    const ALONE: u32 = 9;
    let alone = |watch: &Watch, line: &[AtomicU32; 1]| {
        watch.close();
        line[0].store(ALONE, Ordering::Relaxed);
    };
    model(
        "watch",
        || (Watch::default(), words::<1>()),
        move |(watch, line)| {
            watch.announce(1);
            if watch.known_before(1).is_none() {
                alone(watch, line);
                return None;
            }
            line[0].store(1, Ordering::Relaxed);
            line[0].store(0, Ordering::Relaxed);
            watch.announce(2);
            let known = watch.known_before(2)?;
            alone(watch, line);
            Some(known)
        },
        |(watch, line)| {
            let (mut watched, mut high, mut has_ended) = (0, 0, false);
            for _ in 0..3 {
                let announced = watch.announced();
                if announced == 0 {
                    continue;
                }
                if announced != watched {
                    watch.begin(announced, has_ended.into());
                    (watched, high) = (announced, 0);
                }
                let level = line[0].load(Ordering::Relaxed);
                if level != 0 && high != 0 {
                    let ended = line[0].swap(0, Ordering::Relaxed);
                    assert!(ended == 0 || ended == high, "pulse {ended} is cut short, not {high}");
                    assert!(ended != ALONE, "it is not watched");
                    has_ended = true;
                }
                high = level;
            }
            has_ended
        },
        |_, known, has_ended| assert!(known.is_none_or(|known| known == u32::from(has_ended)), "{known:?} {has_ended}"),
    );
}
