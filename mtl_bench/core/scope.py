"""Python's scopes, as syntax trees tell them: what stands in one, and which names it binds."""

import ast
from collections.abc import Iterable

SCOPES = (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)
COMPREHENSIONS = (ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)
INNER = (*SCOPES, *COMPREHENSIONS, ast.ClassDef, ast.Constant, ast.expr_context)
NAMED = (
    *(ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef),
    *(ast.ExceptHandler, ast.MatchAs, ast.MatchStar),
)


def same_scope(body: Iterable[ast.AST]) -> list[ast.AST]:
    """The nodes of statements without what is inside functions, classes and comprehensions."""
    nodes = list(body)
    for node in nodes:  # which grows meanwhile
        if not isinstance(node, INNER):
            for name in node._fields:
                value = getattr(node, name, None)
                if isinstance(value, ast.AST):
                    nodes.append(value)
                elif isinstance(value, list):
                    nodes += [item for item in value if isinstance(item, ast.AST)]
    return nodes


def bound(nodes: Iterable[ast.AST]) -> set[str]:
    """The names that nodes bind, imports apart."""
    names, elsewhere = set(), set()
    for node in nodes:
        if isinstance(node, ast.Name) and isinstance(node.ctx, (ast.Store, ast.Del)):
            names.add(node.id)
        elif isinstance(node, NAMED) and node.name is not None:
            names.add(node.name)
        elif isinstance(node, ast.MatchMapping) and node.rest:
            names.add(node.rest)
        elif isinstance(node, (ast.Global, ast.Nonlocal)):
            elsewhere.update(node.names)
    return names - elsewhere


def is_text(statement: ast.AST) -> bool:
    """A docstring, `...` or `pass`: nothing that runs."""
    constant = isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)
    return constant or isinstance(statement, ast.Pass)
