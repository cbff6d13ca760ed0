//! Sources of real data: programs that publish items as any program would, through the store.

pub(crate) mod nmea;
pub(crate) mod system;

/// The item `leaf` of the source called `base`: below this host's prefix unless `base` has a prefix of its own.
fn item_name(base: &str, leaf: &str) -> String {
    if base.contains('/') {
        format!("{base}/{leaf}")
    } else {
        format!("./{base}/{leaf}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bare_name_goes_under_this_host() {
        assert_eq!(item_name("gps", "fix"), "./gps/fix");
        assert_eq!(item_name("robot1/gps", "fix"), "robot1/gps/fix");
    }
}
