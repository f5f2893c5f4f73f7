"""Stylised scenes for people without this package: a page, coloured points, a mesh."""
