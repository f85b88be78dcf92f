"""The rules, by what they are about. A new rule is one function with the decorator `registry.rule` in one of these modules."""
