//! Distribution whose output is printed, as the value of `--distro`.

use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};

use super::Dialect;

/// Returns the parser of `--distro`.
#[must_use]
pub fn parser() -> impl TypedValueParser<Value = Dialect> {
    let values = [
        (Dialect::Humble, "Humble and older"),
        (Dialect::Jazzy, "Iron and Jazzy"),
        (Dialect::Kilted, "Kilted"),
        (Dialect::Rolling, "Lyrical and rolling"),
    ]
    .map(|(dialect, help)| {
        let value = PossibleValue::new(dialect.name()).help(help);
        match dialect {
            Dialect::Rolling => value.alias("lyrical"),
            _ => value,
        }
    });
    PossibleValuesParser::new(values)
        .try_map(|name| Dialect::of_distro(&name).ok_or("unknown distribution"))
}

#[cfg(test)]
mod tests {
    use clap::{Arg, Command};

    use super::*;

    #[test]
    fn every_offered_value_names_a_dialect() {
        let parse = |name: &str| {
            let option = Arg::new("distro").long("distro").value_parser(parser());
            let command = Command::new("rp").arg(option);
            let matches = command.try_get_matches_from(["rp", "--distro", name]);
            matches.map(|matches| matches.get_one::<Dialect>("distro").copied())
        };
        let offered: Vec<_> = parser().possible_values().unwrap().collect();
        let names: Vec<_> = offered.iter().map(PossibleValue::get_name).collect();
        assert_eq!(names, ["humble", "jazzy", "kilted", "rolling"]);
        for name in names {
            assert_eq!(parse(name).unwrap().map(Dialect::name), Some(name));
        }
        assert_eq!(parse("lyrical").unwrap(), Some(Dialect::Rolling));
        for name in ["iron", "Jazzy", "noetic"] {
            assert!(parse(name).is_err(), "{name}");
        }
    }
}
