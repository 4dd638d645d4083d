"""An import contract for `make lint`: what is in a room is imported by others from the room only, by its public names.

mypy holds them to the names in the room's `__init__.pyi`; this contract, to not going past it.
"""

import grimp
from importlinter import Contract, ContractCheck, fields, output


class PublicNamesContract(Contract):
    """No module is imported directly from outside of its room, and no name from a package of rooms or from above it.

    Configuration options:
        containers: packages whose direct subpackages are rooms.
        public_modules: modules that are public names themselves, used as `se2.compose`.
    """

    type_name = "public_names"

    containers = fields.ListField(subfield=fields.ModuleField())
    public_modules = fields.ListField(subfield=fields.ModuleField(), required=False, default=[])

    def check(self, graph: grimp.ImportGraph, verbose: bool) -> ContractCheck:
        """Every import past a room's `__init__`, with the lines on which it stands."""
        public = {module.name for module in self.public_modules}  # type: ignore[attr-defined] # as below
        past: list[tuple[str, str, list[int]]] = []
        for package in sorted({each for container in self.containers for each in _with_above(container.name)}):  # type: ignore[attr-defined] # as below
            for importer in sorted(graph.find_modules_that_directly_import(package)):
                details = graph.get_import_details(importer=importer, imported=package)
                past.append((importer, package, [each["line_number"] for each in details]))
        for container in self.containers:  # type: ignore[attr-defined] # import-linter fills fields in
            for room in sorted(graph.find_children(container.name)):
                for module in sorted(graph.find_descendants(room) - public):
                    for importer in sorted(graph.find_modules_that_directly_import(module)):
                        if importer != room and not importer.startswith(f"{room}."):
                            details = graph.get_import_details(importer=importer, imported=module)
                            past.append((importer, module, [each["line_number"] for each in details]))
        return ContractCheck(kept=not past, metadata={"past": past})

    def render_broken_contract(self, check: ContractCheck) -> None:
        """Says which imports they are, and what to do."""
        for importer, module, lines in check.metadata["past"]:
            room = ".".join(module.split(".")[:3]) if module.count(".") > 1 else "the room that has the name"
            output.print_error(
                f"{importer} (l. {', '.join(map(str, lines))}) imports {module}: import from {room}, and add the name "
                "to its __init__.pyi if others are to use it"
            )


def _with_above(name: str) -> list[str]:
    """A package and those that it lies in: a.b, a."""
    parts = name.split(".")
    return [".".join(parts[:n]) for n in range(len(parts), 0, -1)]
