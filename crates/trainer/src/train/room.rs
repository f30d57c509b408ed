//! Whether a run can have more Gaussians than it begins with.

use super::{StrategyKind, TrainSettings, Warning};

/// What a limit below the Gaussians that there are means, or a selection below the points that the
/// run began with: a resumed run may have grown to more. `by_default` says that the limit is not
/// the settings' own.
pub(super) fn warning(
    config: &TrainSettings,
    points: usize,
    gaussians: usize,
    by_default: bool,
) -> Option<Warning> {
    let survivors = match config.strategy {
        StrategyKind::Improved => config.improved.survivors(),
        _ => None,
    };
    if let Some(survivors) = survivors.filter(|survivors| *survivors < points) {
        return Some(Warning::SelectionOfFew {
            survivors,
            gaussians: points,
        });
    }
    let limit = config.max_gaussians().filter(|limit| *limit < gaussians)?;
    Some(Warning::NoRoomToGrow {
        limit,
        gaussians,
        by_default,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_limit_below_the_first_gaussians_is_named() {
        let mut config = TrainSettings::new();
        config.set_max_gaussians(1_000);
        assert_eq!(warning(&config, 1_000, 1_000, false), None);
        let text = |config: &TrainSettings, by_default| {
            warning(config, 1_001, 1_001, by_default)
                .unwrap()
                .to_string()
        };
        let given = text(&config, false);
        assert!(
            given.contains("--max-gaussians 1000") && given.contains("1001"),
            "{given}"
        );
        let default = text(&config, true);
        assert!(default.contains("max_gaussians_share"), "{default}");
        config.strategy = StrategyKind::Improved;
        config.set_max_gaussians(2_000);
        config.improved.selection.final_share = Some(0.3);
        let selected = text(&config, true);
        assert!(
            selected.contains(" 600 ") && selected.contains("1001"),
            "{selected}"
        );
        config.set_max_gaussians(4_000);
        // Nor where a resumed run has grown.
        assert_eq!(warning(&config, 1_001, 4_000, true), None);
    }
}
