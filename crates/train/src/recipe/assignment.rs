//! Overrides of a recipe: `key=value`, where the key is a path such as `stage.grow.params.ssim_weight`.

use std::num::IntErrorKind;
use toml::{Table, Value};

/// The keys and the value of an assignment. A value that is no TOML is a string.
fn split(assignment: &str) -> Result<(Vec<&str>, Value), String> {
    let (path, value) = assignment.split_once('=').ok_or("expected key=value")?;
    // TOML has no larger integers: this would be a string.
    if let Err(error) = value.trim().parse::<i64>()
        && matches!(error.kind(), IntErrorKind::PosOverflow | IntErrorKind::NegOverflow)
    {
        return Err(format!("an integer must be {} to {}", i64::MIN, i64::MAX));
    }
    let value = format!("v = {value}")
        .parse::<Table>()
        .or_else(|_| format!("v = {value:?}").parse::<Table>())
        .map_err(|_| format!("`{value}` is not a TOML value"))?
        .remove("v")
        .ok_or("no value")?;
    let keys = path.split('.').map(|key| key.trim().trim_matches(['"', '\'']));
    Ok((keys.collect(), value))
}

/// Sets one value by its path; in a list of tables (`stage`) an item is selected by its `name`.
pub(super) fn apply(root: &mut Value, assignment: &str) -> Result<(), String> {
    let (keys, value) = split(assignment)?;
    let (last, parents) = keys.split_last().expect("split gives at least one");
    let mut at = root;
    for key in parents {
        at = match at {
            Value::Table(table) => table.entry(*key).or_insert_with(|| Value::Table(Table::new())),
            Value::Array(items) => {
                let names: Vec<String> = items
                    .iter()
                    .filter_map(|i| i.get("name")?.as_str().map(str::to_owned))
                    .collect();
                items
                    .iter_mut()
                    .find(|item| item.get("name").and_then(Value::as_str) == Some(key))
                    .ok_or_else(|| format!("no `{key}` there; there are {}", names.join(", ")))?
            }
            other => return Err(format!("`{key}` is inside a {}", other.type_str())),
        };
    }
    match at {
        Value::Table(table) => {
            table.insert((*last).to_owned(), value);
            Ok(())
        }
        other => Err(format!("`{last}` is inside a {}", other.type_str())),
    }
}

/// Whether one of `assignments` sets the value with the path `path`, or a part of it, in whatever form it is written:
/// `render.background=[1,1,1]` or `render={background=[1,1,1]}`.
pub fn is_assigned(assignments: &[String], path: &str) -> bool {
    let path: Vec<&str> = path.split('.').collect();
    assignments.iter().any(|assignment| {
        let Ok((keys, value)) = split(assignment) else {
            return false;
        };
        match path.strip_prefix(&keys[..]) {
            // Within the table that is assigned.
            Some(rest) => rest.iter().try_fold(&value, |value, key| value.get(*key)).is_some(),
            None => keys.starts_with(&path),
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recipe::{Param, Recipe};

    #[test]
    fn an_assignment_is_recognised_in_every_form() {
        for (assignment, path, expected) in [
            ("render.background=[1,0,0]", "render.background", true),
            (" render.background =[1,0,0]", "render.background", true),
            ("render . \"background\"=[1,0,0]", "render.background", true),
            ("render={background=[1,0,0],antialias=false}", "render.background", true),
            ("render={ \"background\" = [1,0,0] }", "render.background", true),
            ("render={antialias=false}", "render.background", false),
            ("render.background_color=1", "render.background", false),
            ("params={opacity_reg=0.3}", "params.opacity_reg", true),
            ("params={opacity_reg.to=0.3}", "params.opacity_reg", true),
            ("params.opacity_reg.to=0.3", "params.opacity_reg", true),
            ("known_space={opacity_reg=0.3}", "params.opacity_reg", false),
            ("stage.grow.params.opacity_reg=0.3", "params.opacity_reg", false),
            ("nonsense", "params.opacity_reg", false),
        ] {
            assert_eq!(is_assigned(&[assignment.to_owned()], path), expected, "{assignment}");
        }
    }

    #[test]
    fn what_is_set_in_any_form_takes_precedence_over_what_the_data_decide() {
        let fast = Recipe::built_in("fast").expect("built in");
        let is_conditional = |given: &[&str]| {
            let given: Vec<String> = given.iter().map(|given| (*given).to_owned()).collect();
            let recipe = Recipe::parse("fast", fast, &given).expect("valid");
            recipe.known_space.contains_key(&Param::OpacityReg)
        };
        assert!(is_conditional(&[]));
        assert!(!is_conditional(&["params.opacity_reg=0.3"]));
        assert!(!is_conditional(&["params={opacity_reg=0.3}"]));
    }

    #[test]
    fn an_integer_out_of_range_is_not_taken_for_a_string() {
        for assignment in [
            "visits=18446744073709551615",
            "visits = -9223372036854775809",
            "name=99999999999999999999",
        ] {
            let error = apply(&mut Value::Table(Table::new()), assignment).expect_err(assignment);
            assert_eq!(error, "an integer must be -9223372036854775808 to 9223372036854775807");
        }
        for assignment in [
            "visits=9223372036854775807",
            "name=\"99999999999999999999\"",
            "name=9e99",
        ] {
            apply(&mut Value::Table(Table::new()), assignment).expect(assignment);
        }
    }

    #[test]
    fn every_form_sets_the_same() {
        for assignment in [
            "render.color=1",
            " render . 'color' = 1",
            "render={color=1}",
            " render={'color'=1}",
        ] {
            let mut root = Value::Table(Table::new());
            apply(&mut root, assignment).expect(assignment);
            assert_eq!(root["render"]["color"].as_integer(), Some(1), "{assignment}");
        }
    }
}
