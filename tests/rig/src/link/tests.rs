use std::ops::Range;

use proptest::collection::vec;
use proptest::prelude::*;

use super::*;

const FRAMES: u64 = 40_000;

fn at(micros: u64) -> Duration {
    Duration::from_micros(micros)
}

/// Which of so many frames chance takes, one pushed each millisecond.
fn lost(config: Config, seed: u64, count: u64) -> Vec<bool> {
    let mut line = Line::new(config, seed);
    (0..count)
        .map(|number| takes(&mut line, Class::Unicast, at(number * 1_000)))
        .collect()
}

/// Pushes one frame; whether chance took it.
fn takes(line: &mut Line, class: Class, now: Duration) -> bool {
    let before = line.counters().lost;
    line.carry(100, class, now).for_each(drop);
    line.counters().lost > before
}

fn bursts(lost: &[bool]) -> Vec<usize> {
    lost.split(|lost| !lost)
        .map(<[bool]>::len)
        .filter(|length| *length > 0)
        .collect()
}

/// A count as a number to calculate with.
fn real(count: usize) -> f64 {
    f64::from(u32::try_from(count).unwrap())
}

/// Frames of these lengths with gaps of these many microseconds, and when each arrives.
fn arrivals(line: &mut Line, frames: &[(usize, u64)]) -> Vec<(usize, Duration, Duration)> {
    let mut now = Duration::ZERO;
    let mut arrivals = Vec::new();
    for (bytes, gap) in frames {
        now += at(*gap);
        arrivals.extend(
            line.carry(*bytes, Class::Unicast, now)
                .map(|arrival| (*bytes, now, arrival)),
        );
    }
    arrivals
}

fn frames(gaps: Range<u64>) -> impl Strategy<Value = Vec<(usize, u64)>> {
    vec((20..1_500_usize, gaps), 1..300)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn loss_without_memory_has_its_share_and_short_bursts(seed: u64, share in 0.0..0.6) {
        let config = Config { loss: Loss::random(share), ..Config::default() };
        let lost = lost(config, seed, FRAMES);
        let count = real(lost.iter().filter(|lost| **lost).count());
        let bursts = bursts(&lost);
        let deviation = (share * (1.0 - share) * real(lost.len())).sqrt();
        prop_assert!((count - share * real(lost.len())).abs() <= 6.0 * deviation + 1.0, "{count}");
        if share > 0.01 {
            let mean = count / real(bursts.len());
            prop_assert!((mean * (1.0 - share) - 1.0).abs() < 0.2, "bursts of {mean}");
        }
    }

    #[test]
    fn bursts_have_their_share_and_their_mean(
        seed: u64,
        share in 0.02..0.5,
        burst in 1.5..8.0,
    ) {
        let config = Config { loss: Loss { share, burst }, ..Config::default() };
        let lost = lost(config, seed, FRAMES);
        let count = real(lost.iter().filter(|lost| **lost).count());
        let bursts = bursts(&lost);
        let (found, mean) = (count / real(lost.len()), count / real(bursts.len()));
        // Six deviations of the mean of geometric lengths, and of a share whose draws come in bursts.
        let slack = 6.0 / real(bursts.len()).sqrt();
        prop_assert!((mean / burst - 1.0).abs() <= slack, "bursts of {mean}, not {burst}");
        prop_assert!((found / share - 1.0).abs() <= 2.0 * slack, "{found} lost, not {share}");
    }

    #[test]
    fn a_rate_holds_over_every_window(
        seed: u64,
        rate in 50_000..50_000_000_u64,
        duplicate in 0.0..0.5,
        frames in frames(0..2_000),
    ) {
        let config = Config {
            rate: Some(BitsPerSecond(rate)),
            delay: at(500),
            duplicate,
            loss: Loss::random(0.1),
            ..Config::default()
        };
        let arrivals = arrivals(&mut Line::new(config, seed), &frames);
        for (index, (_, _, start)) in arrivals.iter().enumerate() {
            let mut bits = 0;
            for (bytes, _, end) in &arrivals[index + 1..] {
                bits += u128::try_from(*bytes).unwrap() * 8;
                let window = (*end - *start).as_nanos();
                prop_assert!(bits * 1_000_000_000 <= u128::from(rate) * window);
            }
        }
    }

    #[test]
    fn no_frame_waits_longer_than_the_queue_allows(
        rate in 50_000..5_000_000_u64,
        queue in 0..200_u64,
        frames in frames(0..2_000),
    ) {
        let longest = Duration::from_millis(queue);
        let config = Config {
            rate: Some(BitsPerSecond(rate)),
            queue: Queue::Time(longest),
            ..Config::default()
        };
        let mut line = Line::new(config, 1);
        let arrivals = arrivals(&mut line, &frames);
        for (bytes, pushed, arrival) in &arrivals {
            let own = Duration::from_nanos(BitsPerSecond(rate).time_of(*bytes));
            prop_assert!(*arrival - *pushed <= longest + own);
        }
        let dropped = u64::try_from(frames.len() - arrivals.len()).unwrap();
        prop_assert_eq!(line.counters().queue_full, dropped);
    }

    #[test]
    fn a_queue_in_bytes_never_holds_more(most in 1_500..20_000_usize, frames in frames(0..2_000)) {
        let config = Config {
            rate: Some(BitsPerSecond(1_000_000)),
            queue: Queue::Bytes(most),
            ..Config::default()
        };
        let arrivals = arrivals(&mut Line::new(config, 1), &frames);
        for (_, now, _) in &arrivals {
            let inside = arrivals.iter().filter(|(_, pushed, left)| pushed <= now && left > now);
            prop_assert!(inside.map(|(bytes, _, _)| bytes).sum::<usize>() <= most);
        }
    }

    #[test]
    fn jitter_reorders_nothing_by_itself(seed: u64, jitter in 0..50_000_u64, frames in frames(0..200)) {
        let config = Config { delay: at(20_000), jitter: at(jitter), ..Config::default() };
        let mut link = Link::new(config, seed);
        let mut now = Duration::ZERO;
        for (number, (bytes, gap)) in frames.iter().enumerate() {
            now += at(*gap);
            link.push(number, *bytes, Class::Unicast, now);
        }
        let came: Vec<usize> = std::iter::from_fn(|| link.pop(now + at(100_000))).collect();
        prop_assert_eq!(came, (0..frames.len()).collect::<Vec<_>>());
        prop_assert_eq!(link.poll_timeout(), None);
    }

    #[test]
    fn the_same_seed_takes_the_same_frames_whatever_the_timing(
        seed: u64,
        burst in prop::sample::select(vec![1.0, 3.0]),
        gaps in vec(0..3_000_u64, 300),
    ) {
        let loss = Loss { share: 0.3, burst };
        let calm = lost(Config { loss, ..Config::default() }, seed, 300);
        // Another rate, so that the queue is full now and then, and multicast in between.
        let busy = Config {
            loss,
            rate: Some(BitsPerSecond(1_000_000)),
            queue: Queue::Time(at(1_500)),
            jitter: at(9_000),
            duplicate: 0.2,
            ..Config::default()
        };
        let mut line = Line::new(busy, seed);
        let mut now = Duration::ZERO;
        for (gap, was_lost) in gaps.iter().zip(calm) {
            now += at(*gap);
            if gap % 3 == 0 {
                takes(&mut line, Class::Multicast, now);
            }
            let before = line.counters();
            let is_lost = takes(&mut line, Class::Unicast, now);
            if line.counters().queue_full == before.queue_full {
                prop_assert_eq!(is_lost, was_lost);
            }
        }
        prop_assert_ne!(
            lost(Config { loss, ..Config::default() }, seed, 300),
            lost(Config { loss, ..Config::default() }, seed ^ 1, 300)
        );
    }

    #[test]
    fn every_frame_is_in_the_books(seed: u64, mtu in 100..1_500_usize, frames in frames(0..400)) {
        let config = Config {
            rate: Some(BitsPerSecond(10_000_000)),
            queue: Queue::Time(at(2_000)),
            loss: Loss { share: 0.2, burst: 2.0 },
            duplicate: 0.1,
            mtu: Some(mtu),
            ..Config::default()
        };
        let mut line = Line::new(config, seed);
        let came = arrivals(&mut line, &frames).len();
        let books = line.counters();
        prop_assert_eq!(books.offered, u64::try_from(frames.len()).unwrap());
        prop_assert_eq!(books.carried, u64::try_from(came).unwrap());
        let gone = books.lost + books.queue_full + books.too_large;
        prop_assert_eq!(books.carried + gone, books.offered + books.copies);
        let large = frames.iter().filter(|(bytes, _)| *bytes > mtu).count();
        prop_assert!(books.too_large >= u64::try_from(large).unwrap());
    }
}

#[test]
fn a_frame_above_the_mtu_is_dropped_and_one_at_it_passes() {
    let config = Config {
        mtu: Some(1_400),
        ..Config::default()
    };
    let mut line = Line::new(config, 1);

    let large = line.carry(1_401, Class::Unicast, at(0)).count();
    let fits = line.carry(1_400, Class::Unicast, at(0)).count();

    assert_eq!((large, fits, line.counters().too_large), (0, 1, 1));
}

#[test]
fn reordering_happens_when_it_is_asked_for() {
    let config = Config {
        delay: at(10_000),
        jitter: at(5_000),
        reorder: 0.2,
        ..Config::default()
    };
    let mut line = Line::new(config, 1);
    let frames = [(100, 300); 500];

    let arrivals = arrivals(&mut line, &frames);

    let early = arrivals
        .windows(2)
        .filter(|pair| pair[1].2 < pair[0].2)
        .count();
    assert!((50..150).contains(&early), "{early} of 500 overtake");
    let range = at(5_000)..=at(15_000);
    assert!(
        arrivals
            .iter()
            .all(|(_, pushed, came)| *came >= *pushed + *range.start())
    );
}

#[test]
fn a_copy_comes_as_often_as_it_is_asked_for() {
    let config = Config {
        duplicate: 0.25,
        ..Config::default()
    };
    let mut line = Line::new(config, 3);

    let came = arrivals(&mut line, &[(100, 10); 4_000]).len();

    assert!((4_850..5_150).contains(&came), "{came} of 4000");
}

#[test]
fn multicast_has_its_own_rate_and_loss_on_the_same_air() {
    let config = Config {
        rate: Some(BitsPerSecond(8_000_000)),
        multicast_rate: Some(BitsPerSecond(800_000)),
        multicast_loss: Some(Loss::random(1.0)),
        ..Config::default()
    };
    let mut line = Line::new(config, 3);

    let group = line.carry(1_000, Class::Multicast, at(0)).count();
    let one: Vec<_> = line.carry(1_000, Class::Unicast, at(0)).collect();
    let spared: Vec<_> = line.carry(1_000, Class::Spared, at(0)).collect();

    assert_eq!((group, line.counters().lost), (0, 1));
    assert_eq!(one, [at(11_000)]);
    assert_eq!(spared, [at(12_000)]);
}

#[test]
fn what_keeps_the_network_alive_is_never_lost() {
    let config = Config {
        loss: Loss::random(1.0),
        duplicate: 1.0,
        ..Config::default()
    };
    let mut line = Line::new(config, 3);

    assert_eq!(line.carry(60, Class::Spared, at(0)).count(), 1);
    assert_eq!(line.carry(60, Class::Unicast, at(0)).count(), 0);
}

#[test]
fn a_restart_begins_the_chances_anew_and_keeps_what_is_on_the_way() {
    let config = Config {
        delay: at(1_000),
        ..Config::default()
    };
    let mut link = Link::new(config, 1);
    link.push(1, 100, Class::Unicast, at(0));
    let loss = Loss::random(0.5);
    let lossy = Config {
        loss,
        ..Config::default()
    };
    let expected = lost(lossy, 9, 50);

    link.line_mut().restart(lossy, 9);
    let found: Vec<bool> = (0..50)
        .map(|number| takes(link.line_mut(), Class::Unicast, at(number)))
        .collect();

    assert_eq!(found, expected);
    assert_eq!(link.pop(at(1_000)), Some(1));
    assert_eq!(link.line().counters().offered, 51);
}

#[test]
fn every_profile_is_read_by_its_name() {
    for name in Profile::names() {
        let profile = Profile::parse(name).unwrap();
        assert_eq!(profile.to_string(), *name);
        assert_eq!(profile.down.queue, Queue::Time(QUEUE), "{name}");
        assert!(profile.up.jitter <= profile.up.delay, "{name}");
    }
    let lte = Profile::parse("lte").unwrap();
    assert_eq!(lte.up.rate, Some(BitsPerSecond(3_000_000)));
    assert_eq!(lte.down.rate, Some(BitsPerSecond(10_000_000)));
    let broken = Profile::parse("wifi-multicast-broken").unwrap();
    assert_eq!(broken.down.multicast_loss, Some(Loss::random(0.6)));
    assert_eq!(broken.up.multicast_loss, None);
}

#[test]
fn overrides_carry_units_and_may_name_a_direction() {
    let text = "lossy-33 --rate \"200 kbit/s\" --delay 5ms --jitter 500 us --loss 8 % --burst 4 --duplicate 1% \
                --reorder 2.5% --mtu 1280 B --queue 64 KiB --up-rate none --multicast-loss 60% --seed 7";

    let profile = Profile::parse(text).unwrap();

    let Config { loss, .. } = profile.down;
    assert_eq!(profile.down.rate, Some(BitsPerSecond(200_000)));
    assert_eq!(profile.up.rate, None);
    assert_eq!((profile.up.delay, profile.up.jitter), (at(5_000), at(500)));
    assert_eq!((loss.share, loss.burst), (0.08, 4.0));
    assert_eq!((profile.up.duplicate, profile.up.reorder), (0.01, 0.025));
    assert_eq!(
        (profile.up.mtu, profile.up.queue),
        (Some(1_280), Queue::Bytes(65_536))
    );
    assert_eq!(profile.down.multicast_loss, Some(Loss::random(0.6)));
    assert_eq!((profile.up.multicast_loss, profile.seed), (None, 7));
    assert_eq!(Profile::parse(&profile.to_string()), Ok(profile));
}

#[test]
fn what_is_not_understood_is_named_with_what_is() {
    let cases = [
        (
            "lossy-34",
            "`lossy-34` is no link profile (hint: did you mean `lossy-33`?)",
        ),
        (
            "lan --dely 3ms",
            "`dely` is no figure of a link (hint: did you mean `delay`?)",
        ),
        (
            "lan --loss 33",
            "`--loss 33` should be a share such as `33 %`",
        ),
        (
            "lan --loss 101%",
            "`--loss 101%` should be a share such as `33 %`",
        ),
        (
            "lan --rate 200",
            "`--rate 200` should be a rate above zero such as `200 kbit/s`, or `none`",
        ),
        (
            "lan --delay 3 min",
            "`--delay 3 min` should be a time such as `15 ms`",
        ),
        (
            "lan --queue 3",
            "`--queue 3` should be a time such as `100 ms` or a size such as `64 KiB`",
        ),
        (
            "lan --reorder 3%",
            "`--reorder 3%` should be with `--jitter`, which is what reorders",
        ),
        (
            "wifi-bad --loss 90%",
            "`--loss 90%` should be a loss of at most burst / (burst + 1)",
        ),
        (
            "lan --burst 0.5",
            "`--burst 0.5` should be a mean number of frames, from 1, such as `4`",
        ),
    ];
    for (text, expected) in cases {
        assert_eq!(Profile::parse(text).unwrap_err().to_string(), expected);
    }
    let unknown = Profile::parse("zzzzzzzzzzzzzzzzzz")
        .unwrap_err()
        .to_string();
    assert!(unknown.contains("known are lan, wifi-good"), "{unknown}");
}
